"""Ask the kernel for hard timing; what it does not grant is reported and gone without."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from dataclasses import dataclass, field

from surffollow.config.service import Realtime
from surffollow.shm.bit_names import GRANT_NAMES

FIFO, AFFINITY, MLOCKALL, DMA_LATENCY = (1 << i for i in range(4))
_MCL_CURRENT, _MCL_FUTURE = 1, 2


@dataclass
class Grants:
    """Requested and granted."""

    bits: int = 0
    refused: list[str] = field(default_factory=list)
    dma_fd: int = -1

    def names(self) -> list[str]:
        return [n for i, n in enumerate(GRANT_NAMES) if self.bits >> i & 1]

    def note(self, bit: int, error: OSError | None, remedy: str) -> None:
        if error is None:
            self.bits |= bit
        else:
            name = GRANT_NAMES[bit.bit_length() - 1]
            self.refused.append(f"{name}: {error.strerror or error} ({remedy})")


def missing(grants: Grants, expected: Realtime, bits: int) -> list[str]:
    """Configured grants that the kernel refused, with the reasons.

    The wait for a processor of one's own counts only where one is named: else any will do.
    """
    if not expected.lock_memory:
        bits &= ~MLOCKALL
    if expected.cpu < 0:
        bits &= ~AFFINITY
    names = [n for i, n in enumerate(GRANT_NAMES) if bits & ~grants.bits & 1 << i]
    return [next((text for text in grants.refused if text.startswith(f"{n}:")), n) for n in names]


def prepare_process(grants: Grants, lock_memory: bool, dma_latency: bool) -> None:
    """Lock memory and hold the processors out of deep sleep; keep the collector from long pauses."""
    gc.freeze()
    if lock_memory:
        libc = ctypes.CDLL(None, use_errno=True)
        failed = libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0
        error = OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno())) if failed else None
        grants.note(MLOCKALL, error, "raise the memlock limit: ulimit -l unlimited")
    if dma_latency:
        try:
            grants.dma_fd = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
            os.write(grants.dma_fd, b"\0\0\0\0")
            grants.note(DMA_LATENCY, None, "")
        except OSError as e:
            grants.note(DMA_LATENCY, e, "give the service's user write access to /dev/cpu_dma_latency")


def prepare_cycle_thread(grants: Grants, priority: int, cpu: int, thread: int) -> None:
    """Put a thread (its kernel number) under SCHED_FIFO, on one processor when one is named.

    Called for a thread that runs a kernel without the GIL: a real-time thread that waits for its
    processor while it holds the GIL would stop the main thread too.

    Parameters
    ----------
    grants : Grants  receives what was granted and refused
    priority : int   of SCHED_FIFO
    cpu : int        processor; -1: the last of those allowed, when there is more than one
    thread : int     the kernel's number of the thread
    """
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        grants.note(FIFO, None, "")
    except OSError as e:
        grants.note(FIFO, e, "raise the rtprio limit: ulimit -r 99, or run under systemd with LimitRTPRIO=99")
    try:
        allowed = sorted(os.sched_getaffinity(thread))
        chosen = cpu if cpu >= 0 else allowed[-1]
        if cpu >= 0 or len(allowed) > 1:
            os.sched_setaffinity(thread, {chosen})
            grants.note(AFFINITY, None, "")
    except OSError as e:
        grants.note(AFFINITY, e, f"name a processor of {sorted(os.sched_getaffinity(thread))}")


def relax_thread(thread: int, allowed: set[int]) -> None:
    """Remove real time and pinning of a thread, so that it ends though another one holds its processor."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(thread, allowed)
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def release(grants: Grants) -> None:
    """Give the latency hold back."""
    if grants.dma_fd >= 0:
        os.close(grants.dma_fd)
        grants.dma_fd = -1
