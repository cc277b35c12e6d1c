"""The arbiter's process: the loop in a thread without the GIL, the connections in the main thread."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from surffollow.arbiter import handshake as hs
from surffollow.arbiter import layout as al
from surffollow.arbiter import memory as m
from surffollow.arbiter import table as t
from surffollow.arbiter.board import Board, CommandBlock
from surffollow.arbiter.config import ArbiterConfig, is_displacement, limits, reach
from surffollow.arbiter.connections import ConnectionServer, users_of
from surffollow.arbiter.effects import apply_event
from surffollow.arbiter.loop import run_rounds
from surffollow.arbiter.name_owner import own_name
from surffollow.config.group_id import configured_group_id
from surffollow.config.service import mode
from surffollow.errors import ServiceError
from surffollow.shm.ending_signals import EndedEarly, ends_already, handle_ending
from surffollow.shm.name_lock import NameLock
from surffollow.shm.python_atomics import load_acquire, store_release

_SYS_FUTEX_WAITV, _ENOSYS = 449, 38
COUNTER_BITS = 28  # of a token's low half: grants of one resource in one epoch


class Server:
    """One arbiter; `run` returns when a signal asks it to end."""

    def __init__(self, config: ArbiterConfig) -> None:
        self.config, users = config, users_of(config)
        self._listener = hs.listen(config.name)
        self._wake, self._waker = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._own: NameLock | None = None
        self._error = ""
        self._compiling = False
        self._blocks: list[CommandBlock] = []
        self.board: Any = None
        try:
            self._own = own_name(config.name)
            self.board = Board(config)
            access, group = mode(config.mode, "mode"), configured_group_id(config.group, "group")
            for name in (*config.resources, *config.combine):
                self._blocks.append(CommandBlock(f"{config.name}.{name}", access, group))
        except BaseException:
            self._remove_objects()
            self._listener.close()
            self._close_pipe()
            raise
        self.mem = m.make_memory()
        self._connections = ConnectionServer(
            config, users, self.board, self.mem, self._listener, self._wake_loop
        )
        self._fill()

    # -- set-up -----------------------------------------------------------------------------------

    def _fill(self) -> None:
        mem, board, ctx = self.mem, self.board, self.mem.ctx
        ctx[m.N_RESOURCES], ctx[m.N_COMBINATIONS] = len(self.config.resources), len(self.config.combine)
        ctx[m.LEASE_NS], ctx[m.PERIOD_NS] = self.config.lease_ns, self.config.period_ns
        for word, part in ((m.HEADER, "header"), (m.STATUS, "status"), (m.CLIENT_ENTRIES, "clients")):
            ctx[word] = board.address(part)
        for word, part in ((m.GRANTS, "grants"), (m.REPLIES, "replies"), (m.HISTORY, "history")):
            ctx[word] = board.address(part)
        ctx[m.HISTORY_WORDS] = self.config.history * al.EVENT_WORDS
        ctx[m.HAS_WAITV] = has_waitv()
        mem.clients["n"] = al.CLIENTS
        now = time.monotonic_ns()
        for r in range(len(self.config.resources)):
            c, run = board.config[r], mem.runs[r]
            for key in ("n_values", "ttl_ns", "safe_period_ns", "grace_ns", "low", "high", "safe"):
                run[key] = c[key]
            run["combination"] = c["combined_into"]
            run["optional"] = c["combined_into"] >= 0 and c["required"] == 0
            run["lost_ns"] = board.header[0]["lost_ns"][r]
            run["block"], run["fence"] = self._blocks[r].latch, self._blocks[r].fence
            run["command_ns"] = now - int(c["ttl_ns"])
            machine = mem.machines[r]
            machine["cooperative"], machine["newcomer"] = c["cooperative"], c["newcomer"]
            machine["epoch"] = board.epoch - 1  # the event RESTART makes it the new one
        names = list(self.config.resources)
        for k, spec in enumerate(self.config.combine.values()):
            x, block = mem.combinations[k], self._blocks[len(names) + k]
            first = self.config.resources[spec.parts[0]]
            parts = [names.index(p) for p in spec.parts]
            x["n_parts"], x["part"][: len(parts)] = len(parts), parts
            x["required"][: len(parts)] = [p in spec.required for p in spec.parts]
            x["n_values"], x["low"], x["high"] = len(first.command), *limits(spec)
            x["block"], x["fence"], x["changed"] = block.latch, block.fence, 1
            x["period_ns"] = mem.runs[parts[0]]["safe_period_ns"]
            x["ttl_ns"] = mem.runs[parts[0]]["ttl_ns"]
            x["converts"], x["apart"] = is_displacement(first), -1
            x["reach_m"], x["reach_rad"] = reach(self.config, spec)

    def _start_resources(self) -> None:
        for r in range(len(self.config.resources)):
            apply_event(self.mem, r, t.RESTART, -1, 0, 0, time.monotonic_ns())
            self.mem.machines[r]["counter"] = r << COUNTER_BITS  # no two resources grant the same token

    # -- run --------------------------------------------------------------------------------------

    def run(self, on_ready: Callable[[], None] | None = None) -> None:
        """Start the loop, announce READY, welcome clients until asked to stop, end cleanly."""
        thread = threading.Thread(target=self._loop_thread, name="arbiter", daemon=True)
        try:
            self._compiling = True  # before the handlers: a signal right behind them would be lost
            if threading.current_thread() is threading.main_thread():
                # Python runs a handler between two bytecodes: a signal just before a wait would not end it
                signal.set_wakeup_fd(self._waker, warn_on_full_buffer=False)
                handle_ending(lambda number, _: self._on_signal(number))
            self._start_resources()
            run_rounds(self.mem, 0)  # compiles, or loads what was compiled
            self._compiling = False
        except EndedEarly:
            self._compiling = False
            self._end(thread)
            return
        self._wake_loop()
        thread.start()
        try:
            self.board.set_state(al.STATE_READY)
            if on_ready is not None:
                on_ready()
            self._connections.serve_connections(self._wake)
            if self._error:
                raise ServiceError(f"the arbiter's loop failed: {self._error}")
        finally:
            self._end(thread)

    def _on_signal(self, number: int) -> None:
        """Leave a compilation at once; otherwise the wake-up descriptor ends the wait for clients."""
        if self._compiling and not ends_already(EndedEarly):
            raise EndedEarly(number)

    def _loop_thread(self) -> None:
        try:
            run_rounds(self.mem, np.iinfo(np.int64).max)
        except Exception as e:  # the thread must never end unnoticed
            self._error = repr(e)
            self.stop()

    def stop(self) -> None:
        """Ask `run` to end, from another thread."""
        with contextlib.suppress(OSError):
            os.write(self._waker, b"x")

    def _wake_loop(self) -> None:
        from surffollow.arbiter.python_futex import wake

        address = int(self.mem.ctx.ctypes.data) + 8 * m.DOORBELL
        store_release(address, load_acquire(address) + 1)
        wake(address)

    def _end(self, thread: threading.Thread) -> None:
        self._connections.release_clients(thread)
        store_release(int(self.mem.ctx.ctypes.data) + 8 * m.STOP, 1)
        self._wake_loop()
        if thread.ident is not None:  # it was started
            thread.join(2.0)
        if thread.is_alive():
            os._exit(1)  # its memory must not go away under it
        self._remove_objects()
        self._connections.close()
        self._listener.close()
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(-1)
        self._close_pipe()

    def _close_pipe(self) -> None:
        os.close(self._wake)
        os.close(self._waker)

    def _remove_objects(self) -> None:
        for block in self._blocks:
            block.remove()
        if self.board is not None:
            self.board.remove()
        if self._own is not None:
            self._own.release()


def has_waitv() -> int:
    """Whether this kernel knows futex_waitv (1, 0); without it the loop looks every millisecond."""
    import ctypes

    libc: Any = ctypes.CDLL(None, use_errno=True)
    failed = libc.syscall(_SYS_FUTEX_WAITV, None, 0, 0, None, 0) < 0
    return int(not (failed and ctypes.get_errno() == _ENOSYS))


def serve(config: ArbiterConfig, quiet: bool = False) -> None:
    """Run an arbiter in the foreground until SIGTERM, SIGINT or SIGHUP."""
    if not quiet:
        print(f"surffollow: starting arbiter {config.name!r}", file=sys.stderr, flush=True)
    server = Server(config)
    server.run(lambda: print(f"READY {config.name} pid {os.getpid()}", flush=True))
