"""Attacks of a hostile user on a service, for bench_fuzz: each kind of attack is the work of one process."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import time
from collections.abc import Callable
from pathlib import Path

from lingering import hand_over, lingering
from raw_slot import fill_silent_connections, raw_slot
from scribbler import Writer
from second_user import OtherUser
from service.test_foreign_names import lock_everything
from surffollow.client import attach
from surffollow.errors import SurffollowError
from surffollow.shm import layout_slot as ls
from surffollow.shm.unix_socket import socket_path

KINDS = (
    *("scribble", "cut", "restore", "punch", "lock", "impostor", "full"),
    *("churn", "linger", "crowd", "audit"),
)
SHM = Path("/dev/shm")
_PUNCH_AND_KEEP_SIZE = 3


def attack(kind: str, name: str, seed: int) -> Callable[[OtherUser], None]:
    """Work of the attacker's process until it is killed; it counts its attacks."""
    libc = ctypes.CDLL(None)

    def scribble(step: int, held: tuple[int, mmap.mmap, Writer]) -> None:
        writer = held[2]
        writer.noise() if step % 2 else writer.commands(step)

    def cut(_: int, held: tuple[int, mmap.mmap, Writer]) -> None:
        for path in (SHM / name, SHM / f"{name}.map"):
            with contextlib.suppress(OSError):
                os.truncate(path, 0)
        os.ftruncate(held[0], 0)

    def restore(_: int, held: tuple[int, mmap.mmap, Writer]) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(held[0], 0)
        time.sleep(0.004)
        os.ftruncate(held[0], ls.SLOT_BYTES)

    def punch(_: int, held: tuple[int, mmap.mmap, Writer]) -> None:
        libc.fallocate(held[0], _PUNCH_AND_KEEP_SIZE, ctypes.c_long(0), ctypes.c_long(ls.SLOT_BYTES))
        held[1].madvise(mmap.MADV_REMOVE)

    one = {"scribble": scribble, "cut": cut, "restore": restore, "punch": punch}

    def on_slot(child: OtherUser) -> None:
        _sock, fd, memory, _ = raw_slot(name)
        held = fd, memory, Writer(memory, seed)
        child.say("attacks")
        step = 0
        while True:
            step += 1
            with contextlib.suppress(OSError):
                one[kind](step, held)

    def lock(child: OtherUser) -> None:
        held = [lock_everything(SHM / part) for part in (name, f"{name}.map")]
        child.say("attacks")
        while held:
            with contextlib.suppress(OSError):
                held.append(lock_everything(SHM / f"{name}.lock"))
            time.sleep(0.001)

    def full(child: OtherUser) -> None:
        with (SHM / f"{name}.filler").open("wb", buffering=0) as f, contextlib.suppress(OSError):
            while f.write(bytes(1 << 20)):
                pass
        child.say("attacks")
        while True:
            with contextlib.suppress(OSError), (SHM / f"{name}.filler").open("ab", buffering=0) as f:
                f.write(bytes(4096))
            time.sleep(0.001)

    def churn(child: OtherUser) -> None:
        child.say("attacks")
        while True:
            with contextlib.suppress(OSError, AssertionError):
                sock, fd, memory, _ = raw_slot(name)
                Writer(memory, seed).noise()
                memory.close()
                os.close(fd)
                sock.close()

    def linger(child: OtherUser) -> None:
        child.say("attacks")
        with lingering() as held:
            while True:
                with contextlib.suppress(OSError):
                    hand_over(name, held.fileno(), [], b"x")

    def audit(child: OtherUser) -> None:
        with attach(name, label="flood", owner=os.stat(SHM / name).st_uid, stale_min_s=1.0) as client:
            child.say("attacks")
            while True:
                with contextlib.suppress(SurffollowError):
                    client.set_params(max_demand=5.0, wait=False)

    alone = {"lock": lock, "full": full, "churn": churn, "linger": linger, "audit": audit}
    return alone.get(
        kind,
        fill_silent_connections(str(socket_path(name))) if kind == "crowd" else on_slot,
    )
