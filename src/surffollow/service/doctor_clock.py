"""Checks of the clock, and of what withholds the processor."""

from __future__ import annotations

import os
import re
import threading
import time
from pathlib import Path

from surffollow.service.doctor_finding import FAIR, GOOD, LACKING, UNKNOWN, Finding, read_text

PRIORITY = 80
JITTER_S = 0.25
JITTER_GOOD_NS, JITTER_FAIR_NS = 50_000, 1_000_000
_CLOCK = "devices/system/clocksource/clocksource0"


def check_clock(root: Path) -> Finding:
    """Whether reading the clock is cheap."""
    why = "the cycle reads the clock some ten times; a slow source makes each a system call"
    source = read_text(root / "sys" / _CLOCK / "current_clocksource")
    if source is None:
        return Finding("clock source", UNKNOWN, "not reported by the kernel", why)
    if source in ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"):
        return Finding("clock source", GOOD, source, why)
    return Finding(
        "clock source",
        LACKING,
        source,
        why,
        f"echo tsc > /sys/{_CLOCK}/current_clocksource, if it is offered there; boot with tsc=reliable",
    )


def check_hypervisor(root: Path) -> Finding:
    """Whether a host may take the processor away."""
    why = "the host of a virtual machine takes the processor away without telling, for milliseconds"
    flags = re.search(r"^flags\s*:(.*)$", read_text(root / "proc/cpuinfo") or "", re.MULTILINE)
    kind = read_text(root / "sys/hypervisor/type")
    virtual = kind or ("yes" if flags and "hypervisor" in flags[1].split() else "")
    if not virtual:
        return Finding("virtual machine", GOOD, "none seen", why)
    stolen = re.search(r"^cpu\s+(?:\d+\s+){7}(\d+)", read_text(root / "proc/stat") or "", re.MULTILINE)
    ticks = f", {int(stolen[1]) / 100:.1f} s of processor time stolen since boot" if stolen else ""
    remedy = "move a robot's controller to a real machine; or pin the guest's processors on its host"
    return Finding("virtual machine", FAIR, f"{virtual}{ticks}", why, remedy)


def longest_gap_ns(seconds: float) -> tuple[int, bool]:
    """The longest time that a spinning thread was kept from the clock, and whether it had SCHED_FIFO."""
    out: list[tuple[int, bool]] = []

    def spin() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            fifo = True
        except OSError:
            fifo = False
        now, longest, clock = time.monotonic_ns(), 0, time.monotonic_ns
        until = now + int(seconds * 1e9)
        while now < until:
            last, now = now, clock()
            if now - last > longest:
                longest = now - last
        out.append((longest, fifo))

    thread = threading.Thread(target=spin)
    thread.start()
    thread.join()
    return out[0]


def check_jitter(root: Path) -> Finding:
    """A short look at how long the machine withholds the processor."""
    longest, fifo = longest_gap_ns(JITTER_S)
    why = (
        "what interrupts a spinning thread delays the cycle by as much; `surffollow latency` measures it well"
    )
    state = GOOD if longest <= JITTER_GOOD_NS else FAIR if longest <= JITTER_FAIR_NS else LACKING
    policy = "under SCHED_FIFO" if fifo else "without real-time priority"
    remedy = "" if state == GOOD else "see the lines above; firmware (SMI) settings; a quieter machine"
    found = f"{longest / 1e3:.0f} µs at most in {JITTER_S:g} s of spinning {policy}"
    return Finding("jitter", state, found, why, remedy)
