"""The service process: initialise, then for ever requests and data; the main thread watches over both."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable

from surffollow.config.service import ServiceConfig, seconds
from surffollow.errors import ServiceError
from surffollow.forecast.step import sf_reset
from surffollow.hw.driver import ConversionQueue, Driver, reports_of
from surffollow.hw.pushed_ranges import pushed_of
from surffollow.hw.registry import make_driver
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.service import memory as m
from surffollow.service import realtime
from surffollow.service.answers import publish_params
from surffollow.service.client_table import ClientTable, Limits
from surffollow.service.compile_helper import SideCompile, note_complete
from surffollow.service.cycle import run_cycles
from surffollow.service.driver_watch import DriverWatch
from surffollow.service.heartbeat import FAULT_CYCLE_STALLED, Heartbeat
from surffollow.service.initialise import (
    forget_parameters,
    initialise_constants,
    initialise_log,
    initialise_memory,
    make_change_queue,
    make_sample_ring,
    stop_after_end,
)
from surffollow.service.kept_stop import text_at_start
from surffollow.service.mapper import run_map
from surffollow.service.mapper_memory import make_map_memory
from surffollow.service.messages import STDOUT, Messages
from surffollow.service.mount_notes import MountWatch
from surffollow.service.notify import CompileProgress, sd_notify
from surffollow.service.plant_note import PlantWatch
from surffollow.service.shared_objects import SharedObjects, open_shared_objects
from surffollow.service.slot_server import SlotServer
from surffollow.service.worker_threads import WorkerThreads
from surffollow.shm import layout_board as lb
from surffollow.shm.ending_signals import EndedEarly, ends_already, handle_ending
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_follow import Output
from surffollow.shm.python_atomics import store_release
from surffollow.shm.readable import wait_readable

HOUSEKEEPING_S = 0.05
DRIVER_END_S = 4.0
END_S = 8.0  # for both threads to end, the map's queue applied


class Daemon:
    """One running service; `run` returns when a signal asks it to end."""

    def __init__(self, config: ServiceConfig, quiet: bool = False, messages: Messages | None = None) -> None:
        self.config, self.quiet = config, quiet
        self.grants = realtime.Grants()
        self.driver: Driver = make_driver(config.driver, config.name)
        self.objects: SharedObjects = open_shared_objects(config)
        try:
            self.queue = ConversionQueue(1 << 15)
            self.samples = make_sample_ring(config, int(self.objects.header[0]["period_ns"]))
            self.mem = initialise_memory(
                config,
                self.objects,
                self.queue,
                self.samples,
                reports_of(self.driver),
                pushed_of(self.driver),
            )
            self.map_mem = make_map_memory(
                self.mem.ctx,
                self.objects.map_header,
                self.objects.pairs,
                self.objects.scratch,
            )
            initialise_constants(self.mem.params, config, self.driver.info)
            initialise_log(config, self.objects)
            self.messages = Messages() if messages is None else messages
            self._changes = make_change_queue(self.mem)
            self._driver_watch = DriverWatch(self.driver)
            self._threads = WorkerThreads(self.mem, self.map_mem, self.objects.address("stats"))
            self._slots = self._make_slot_server()
            self._mounts = MountWatch(self.mem.params, self.driver.info, self.mem.state)
            self._heartbeat = Heartbeat(
                self.objects,
                self.mem.ctx,
                self._driver_watch,
                self.grants,
                self._slots,
                self.messages,
                self._mounts,
                PlantWatch(self.mem.params, self.mem.state),
            )
            self._wake, self._waker = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        except BaseException:
            self.objects.leave()
            raise
        self._compiling = self._in_force = False

    def _make_slot_server(self) -> SlotServer:
        objects, access = self.objects, self.config.access
        limits = Limits(access.slots_per_user, access.slots_per_process)
        table = ClientTable(
            objects.slots, self.mem.ctx, objects.address("clients"), self._threads.cycles, limits
        )
        return SlotServer(objects.listener, table, objects.epoch)

    # -- run --------------------------------------------------------------------------------------

    def run(self, on_ready: Callable[[], None] | None = None) -> None:
        """Start the threads, announce READY, do housekeeping until asked to stop, end cleanly."""
        self._take_signals()
        side = SideCompile(with_sensors=isinstance(self.driver, SimulatedDriver))
        try:
            realtime.prepare_process(
                self.grants, self.config.realtime.lock_memory, self.config.realtime.dma_latency
            )
            self._require_realtime(realtime.MLOCKALL)
            if not self._compile(side) or wait_readable(self._wake, 0.0):
                return
            self._prioritise_cycle(self._threads.start())
            self._require_realtime(realtime.FIFO | realtime.AFFINITY | realtime.MLOCKALL)
            for note in self._mounts.notes():
                self.messages.report(note)
            self._heartbeat.publish()  # whoever sees READY sees the grants
            self.objects.set_state(lb.STATE_READY)
            sd_notify(f"READY=1\nSTATUS=cycle {self.mem.ctx[m.PERIOD_NS] / 1e6:g} ms")
            if on_ready is not None:
                on_ready()
            self._watch()
        finally:
            side.end()
            self._end()

    def _require_realtime(self, bits: int) -> None:
        """Refuse to start without the configured grants of the kernel, when it is strict about it."""
        missing = realtime.missing(self.grants, self.config.realtime, bits)
        if missing and self.config.realtime.strict:
            raise ServiceError(
                f"strict start: the kernel does not grant {'; '.join(missing)}; "
                "`surffollow doctor` says how to get it, or start without --strict (realtime.strict)"
            )

    def _compile(self, side: SideCompile) -> bool:
        """Call every kernel once, which compiles it or loads it; False when asked to end meanwhile."""
        stop = self.mem.ctx.ctypes.data + 8 * m.STOP
        # from here on telling compiles nothing
        self._heartbeat.compiling("compiling kernels for this machine")
        with CompileProgress(self.messages.write, self.quiet, self._heartbeat.compiling) as progress:
            try:
                self._compiling = True
                if wait_readable(self._wake, 0.0):  # asked before a signal could leave the compilation
                    return False
                side.compile_step(self.mem)
                run_cycles(self.mem, 0, 0)
                # the paper's initialisation of the forecast is SFReset itself
                sf_reset(self.mem.params, self.mem.state, self.mem.params[0]["offset_m"])
                differ, self._in_force = stop_after_end(self.mem, self.objects), True
                self._report_stop(differ)
                if not side.wait(progress.waiting, self._wake):
                    return False
                store_release(stop, 1)
                run_map(self.map_mem)
                publish_params(self.mem)
            except EndedEarly:
                return False
            finally:
                self._compiling = False
            self._heartbeat.publish()
            self.driver.start(self.queue)
            self._driver_watch.start()
        store_release(stop, 0)
        note_complete()
        return True

    def _report_stop(self, differ: bool) -> None:
        """Report a stop with which the service starts; `differ`: the parameters are not those before."""
        causes = int(self.mem.state[0]["stop"])
        if causes:
            self.messages.report(text_at_start(causes, differ))
            self._heartbeat.begin_stopped(causes)

    def _prioritise_cycle(self, thread: int) -> None:
        real_time = self.config.realtime
        realtime.prepare_cycle_thread(self.grants, real_time.priority, real_time.cpu, thread)

    def _take_signals(self) -> None:
        if threading.current_thread() is threading.main_thread():
            handle_ending(lambda number, _: self._on_signal(number))
            signal.signal(signal.SIGIO, signal.SIG_IGN)  # a process opened memory that is being examined

    def _on_signal(self, number: int) -> None:
        """Ask to end; a compilation, which may last a minute, is left at once."""
        self.stop()
        if self._compiling and not ends_already(EndedEarly):
            raise EndedEarly(number)

    def stop(self) -> None:
        """Ask `run` to end, from a signal handler or another thread (a pipe holds no lock)."""
        with contextlib.suppress(OSError):  # full, or closed because it ended
            os.write(self._waker, b"x")

    def _serve(self) -> bool:
        """Serve the clients until the next housekeeping period; True when asked to end."""
        asked = self._heartbeat.guard.run(
            "serving the clients", lambda: self._slots.serve(self._wake, HOUSEKEEPING_S), None
        )
        return wait_readable(self._wake, HOUSEKEEPING_S) if asked is None else asked

    def _watch(self) -> None:
        stall_s = seconds(self.config.watchdog, "watchdog", 0.01, 60.0)
        seen, since, stalled = -1, time.monotonic(), False
        while not self._serve():
            cycles, now = self._threads.cycles(), time.monotonic()
            if cycles != seen:
                seen, since = cycles, now
                sd_notify("WATCHDOG=1")
            if (now - since > stall_s) != stalled:
                stalled = not stalled
                said = f"stands still for {now - since:.3g} s; does another process hold its processor?"
                self.messages.report(f"the cycle {said if stalled else 'runs again'}")
            self._heartbeat.publish(FAULT_CYCLE_STALLED if stalled else 0)
            if self._threads.errors:
                raise ServiceError("; ".join(self._threads.errors))

    def _end(self) -> None:
        try:
            self._end_threads()
        finally:  # after any failure the names are given back
            if not self._threads.alive():
                self.objects.leave()
                realtime.release(self.grants)
            os.close(self._wake)
            os.close(self._waker)

    def _end_threads(self) -> None:
        run = self._heartbeat.guard.run
        run("telling the service manager", lambda: sd_notify("STOPPING=1"), None)
        self.objects.set_state(lb.STATE_STOPPING)
        run("stopping the driver", lambda: self._driver_watch.stop(DRIVER_END_S), None)
        self._threads.end(END_S)
        alive = self._threads.alive()
        if alive:
            # its memory must not go away under a thread: leave the names to the next start and end at once
            self.messages.report(f"thread {', '.join(alive)} does not end; giving up")
            self.messages.end()
            os._exit(1)
        self.mem.output[0]["status"] = 0
        self.mem.output[0]["demand"] = 0.0
        latch_write(self.objects.address("output"), self.mem.output.ctypes.data, Output.SIZE)
        if self._in_force and wait_readable(self._wake, 0.0):  # the end was requested: no fault caused it
            self._serve()  # clients that have left meanwhile hold nothing
            forget_parameters(self.mem, self.objects)
        self._heartbeat.end()
        self.objects.set_state(lb.STATE_STOPPED)
        run("letting the clients go", self._slots.close, None)


def serve(config: ServiceConfig, quiet: bool = False) -> None:
    """Run a service in the foreground until SIGTERM, SIGINT or SIGHUP."""
    messages = Messages().start()
    interrupted: list[int] = []

    def interrupt(number: int, _: object) -> None:
        interrupted.append(number)
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGINT, interrupt)
        daemon = Daemon(config, quiet, messages)
        if interrupted:  # and a callback, of the compiler or a driver's library, swallowed the exception
            daemon.stop()

        def ready() -> None:
            refused = "; ".join(daemon.grants.refused)
            if not quiet:
                granted = ", ".join(daemon.grants.names()) or "nothing"
                suffix = f"; refused: {refused}" if refused else ""
                messages.report(f"real time granted: {granted}{suffix}")
            messages.write(f"READY {config.name} pid {os.getpid()}\n", fd=STDOUT, limited=False)

        daemon.run(ready)
    finally:
        messages.end()
