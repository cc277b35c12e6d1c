"""Missing settings of this machine for hard timing, with reason and remedy (`surffollow doctor`).

Each check looks, changes nothing that outlasts it, and says what it found. The files it
reads lie under a root that tests replace.
"""

from __future__ import annotations

import os
import platform
import re
import resource
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from surffollow.service.doctor_clock import PRIORITY, check_clock, check_hypervisor, check_jitter
from surffollow.service.doctor_finding import FAIR, GOOD, LACKING, UNKNOWN, Finding, read_text
from surffollow.service.doctor_host import check_huge_pages, check_interrupts, check_remove_ipc, check_swap

# a service with the default map of a million grids needs about 4 MiB, logs and blocks more
SHM_GOOD_BYTES = 64 << 20
_CAP_IPC_LOCK = 14


def check_priority(root: Path) -> Finding:
    """Whether a thread may run under SCHED_FIFO: tried in a thread of its own."""
    outcome: list[str] = []

    def ask() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            outcome.append("")
        except OSError as e:
            outcome.append(e.strerror or str(e))

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    _, hard = resource.getrlimit(resource.RLIMIT_RTPRIO)
    why = "the cycle must run before everything else when its time has come"
    if not outcome[0]:
        return Finding("real-time priority", GOOD, f"SCHED_FIFO {PRIORITY} is granted", why)
    return Finding(
        "real-time priority",
        LACKING,
        f"SCHED_FIFO {PRIORITY} is refused ({outcome[0]}); the rtprio limit is {hard}",
        why,
        "add '@realtime - rtprio 99' to /etc/security/limits.d/realtime.conf, join that group and log in "
        "anew; under systemd: LimitRTPRIO=99",
    )


def check_memory_lock(root: Path) -> Finding:
    """Whether all memory may be locked."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    status = read_text(root / "proc/self/status") or ""
    capabilities = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    may = bool(capabilities and int(capabilities[1], 16) >> _CAP_IPC_LOCK & 1)
    why = "a page fault in the cycle costs from microseconds to the time of a disk"
    limit = "unlimited" if soft == resource.RLIM_INFINITY else f"{soft / 2**20:.0f} MiB"
    if may or soft == resource.RLIM_INFINITY:
        how = "CAP_IPC_LOCK" if may else "no limit"
        return Finding("locked memory", GOOD, f"all memory may be locked ({how})", why)
    remedy = (
        "add '@realtime - memlock unlimited' to /etc/security/limits.d/realtime.conf; systemd: LimitMEMLOCK="
    )
    return Finding("locked memory", LACKING, f"the memlock limit is {limit}", why, remedy + "infinity")


def check_preemption(root: Path) -> Finding:
    """The kernel's preemption model."""
    version = read_text(root / "proc/version") or platform.version()
    # debugfs says what is in force, and needs root; the command line says what was asked for
    chosen = re.search(r"\((\w+)\)", read_text(root / "sys/kernel/debug/sched/preempt") or "") or re.search(
        r"\bpreempt=(\w+)", read_text(root / "proc/cmdline") or ""
    )
    why = "without full preemption a driver or system call of any process may delay the cycle by milliseconds"
    remedy = "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64; since 6.12 CONFIG_PREEMPT_RT=y)"
    if read_text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel preemption", GOOD, "PREEMPT_RT", why)
    if "PREEMPT_DYNAMIC" in version:
        mode = f", now {chosen[1]}" if chosen else ""
        state = FAIR if not chosen or chosen[1] in ("full", "lazy") else LACKING
        return Finding(
            "kernel preemption",
            state,
            f"PREEMPT_DYNAMIC{mode}",
            why,
            f"boot with preempt=full, or {remedy}",
        )
    if "PREEMPT" in version:
        return Finding("kernel preemption", FAIR, "PREEMPT", why, remedy)
    return Finding("kernel preemption", LACKING, "the kernel does not preempt itself", why, remedy)


def check_governor(root: Path) -> Finding:
    """Whether processors keep their clock rate."""
    why = "a processor that slowed down does the same cycle in several times the time"
    cpus = root / "sys/devices/system/cpu"
    governors = {read_text(p) or "?" for p in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    if not governors:
        return Finding(
            "clock governor", UNKNOWN, "not controlled from here (a virtual machine, or firmware)", why
        )
    found = ", ".join(sorted(governors))
    if governors == {"performance"}:
        return Finding("clock governor", GOOD, found, why)
    return Finding(
        "clock governor",
        LACKING,
        found,
        why,
        "cpupower frequency-set -g performance; boot with cpufreq.default_governor=performance",
    )


def check_isolation(root: Path) -> Finding:
    """Whether processors are kept free for the cycle."""
    cpus = root / "sys/devices/system/cpu"
    isolated, tickless = read_text(cpus / "isolated") or "", read_text(cpus / "nohz_full") or ""
    tickless = "" if tickless == "(null)" else tickless
    allowed = len(os.sched_getaffinity(0))
    why = "on a processor of its own the cycle meets no other thread, and no timer tick, at its deadline"
    found = f"isolcpus {isolated or 'none'}, nohz_full {tickless or 'none'}, {allowed} processors allowed"
    if isolated and tickless:
        return Finding("isolated processors", GOOD, found, why)
    remedy = (
        "boot with isolcpus=N nohz_full=N rcu_nocbs=N and name it in the configuration (realtime.cpu = N)"
    )
    state = FAIR if isolated or allowed > 1 else LACKING
    if allowed < 2:
        remedy = "give the service two processors or more: its cycle and its map are two threads"
    return Finding("isolated processors", state, found, why, remedy)


def check_throttling(root: Path) -> Finding:
    """Whether the kernel takes real-time threads off the processor."""
    why = "real-time threads are stopped when they used more than this share of each second"
    runtime = read_text(root / "proc/sys/kernel/sched_rt_runtime_us")
    period = read_text(root / "proc/sys/kernel/sched_rt_period_us")
    if runtime is None or period is None:
        return Finding("real-time throttling", UNKNOWN, "sched_rt_runtime_us cannot be read", why)
    if int(runtime) < 0:
        return Finding("real-time throttling", GOOD, "off", why)
    share = int(runtime) / int(period)
    # the cycle spins for a tenth of its period: only a cycle of 20 kHz or more comes near the usual 95 %
    state = GOOD if share >= 0.9 else LACKING if share < 0.5 else FAIR
    return Finding(
        "real-time throttling",
        state,
        f"{share:.0%} of each {int(period) / 1e6:g} s",
        why,
        ""
        if state == GOOD
        else "sysctl kernel.sched_rt_runtime_us=950000 (or -1 on a machine that does only this)",
    )


def check_dma_latency(root: Path) -> Finding:
    """Whether the processors may be kept out of deep sleep."""
    why = "a processor takes up to hundreds of microseconds to wake from its deepest sleep"
    path = root / "dev/cpu_dma_latency"
    if not path.exists():
        return Finding("sleep states", UNKNOWN, f"there is no {path.name}", why, "")
    if os.access(path, os.W_OK):
        return Finding("sleep states", GOOD, "/dev/cpu_dma_latency may be held at 0", why)
    remedy = 'udev rule: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"; or boot with cpuidle.off=1'
    return Finding("sleep states", LACKING, "/dev/cpu_dma_latency may not be written", why, remedy)


def check_shm(root: Path) -> Finding:
    """Whether /dev/shm is there and large enough."""
    why = "the map, the board and all blocks live there; every page is reserved before use"
    remedy = "mount -o remount,size=1G /dev/shm (in a container: --shm-size=1g)"
    path = root / "dev/shm"
    try:
        room = os.statvfs(path)
    except OSError as e:
        return Finding(
            "shared memory", LACKING, f"/dev/shm: {e.strerror}", why, "mount -t tmpfs tmpfs /dev/shm"
        )
    free = room.f_bavail * room.f_frsize
    writable = os.access(path, os.W_OK)
    found = f"{free / 2**20:.0f} MiB free" + ("" if writable else ", not writable")
    if writable and free >= SHM_GOOD_BYTES:
        return Finding("shared memory", GOOD, found, why)
    return Finding("shared memory", FAIR if writable and free >= 8 << 20 else LACKING, found, why, remedy)


CHECKS: tuple[Callable[[Path], Finding], ...] = (
    check_priority,
    check_memory_lock,
    check_dma_latency,
    check_preemption,
    check_isolation,
    check_interrupts,
    check_throttling,
    check_governor,
    check_huge_pages,
    check_swap,
    check_clock,
    check_hypervisor,
    check_shm,
    check_remove_ipc,
    check_jitter,
)


def examine(root: Path = Path("/")) -> list[Finding]:
    """All checks, in the order of what helps most."""
    return [check(root) for check in CHECKS]


def machine() -> dict[str, Any]:
    """The examined part."""
    return {
        "kernel": platform.release(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "allowed": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
    }
