"""Checks of `surffollow doctor` on the host: what a machine in production must not do to the cycle."""

from __future__ import annotations

import os
import re
from pathlib import Path

from surffollow.service.doctor_finding import FAIR, GOOD, LACKING, UNKNOWN, Finding, read_text

FIRST_LOGIN_UID = 1000  # logind removes objects of users from here on


def cpu_list(text: str) -> set[int]:
    """Processors of a list such as "0-2,5"; what is no list gives none."""
    found: set[int] = set()
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if ends:
            found |= set(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return found


def check_remove_ipc(root: Path) -> Finding:
    """Whether logind unlinks the shared-memory objects when the service's user logs out."""
    why = (
        "logind unlinks a user's objects in /dev/shm at logout: the service runs on under names that are gone"
    )
    if not (root / "run/systemd/system").exists():
        return Finding("logind RemoveIPC", GOOD, "there is no systemd-logind", why)
    places = [root / "etc/systemd/logind.conf"]
    for folder in ("usr/lib/systemd", "run/systemd", "etc/systemd"):
        places += sorted((root / folder / "logind.conf.d").glob("*.conf"))
    removes, where = True, "the built-in default"
    for place in places:
        for value in re.findall(r"^\s*RemoveIPC\s*=\s*(\S+)", read_text(place) or "", re.MULTILINE):
            removes, where = value.lower() in ("yes", "true", "on", "1"), f"/{place.relative_to(root)}"
    if not removes:
        return Finding("logind RemoveIPC", GOOD, f"no ({where})", why)
    if os.geteuid() < FIRST_LOGIN_UID:
        return Finding("logind RemoveIPC", GOOD, f"yes ({where}), but not for system users such as this", why)
    return Finding(
        "logind RemoveIPC",
        LACKING,
        f"yes ({where}), and this is user {os.geteuid()}",
        why,
        "mkdir -p /etc/systemd/logind.conf.d && printf '[Login]\\nRemoveIPC=no\\n' > "
        "/etc/systemd/logind.conf.d/surffollow.conf && systemctl restart systemd-logind; "
        "or run the service as a system user",
    )


def check_interrupts(root: Path) -> Finding:
    """Whether devices interrupt the cycle's processor."""
    why = "an interrupt's handler runs before the cycle, at any priority"
    allowed = os.sched_getaffinity(0)
    core = max(allowed)  # as the service chooses
    there, possible = [], []
    for folder in sorted((root / "proc/irq").glob("[0-9]*"), key=lambda p: int(p.name)):
        lists = [read_text(folder / f) for f in ("effective_affinity_list", "smp_affinity_list")]
        now = next((text for text in lists if text), "")
        # an interrupt that no driver has asked for has no folder below its number
        if not now or not any(p.is_dir() for p in folder.iterdir()):
            continue
        if core in cpu_list(now):
            there.append(folder.name)
        elif core in cpu_list(lists[1] or ""):
            possible.append(folder.name)
    if not there and not possible:
        return Finding("interrupts", GOOD, f"none may come to processor {core}", why)
    online = cpu_list(read_text(root / "sys/devices/system/cpu/online") or "")
    others = ",".join(str(c) for c in sorted(online - {core}))
    remedy = (
        "systemctl disable --now irqbalance; for f in /proc/irq/*/smp_affinity_list; "
        f"do echo {others} > $f; done; boot with irqaffinity={others}"
    )
    found = f"processor {core}: {len(there)} interrupts come to it, {len(possible)} more may"
    return Finding("interrupts", LACKING if there and others else FAIR, found, why, remedy if others else "")


def check_huge_pages(root: Path) -> Finding:
    """Whether the kernel gathers small pages into huge ones behind a process's back."""
    why = "the kernel stalls a process while it gathers its pages into huge ones"
    text = read_text(root / "sys/kernel/mm/transparent_hugepage/enabled")
    mode = re.search(r"\[(\w+)\]", text or "")
    if mode is None:
        return Finding("transparent huge pages", GOOD, "the kernel has none", why)
    if mode[1] in ("never", "madvise"):
        return Finding("transparent huge pages", GOOD, mode[1], why)
    remedy = (
        "echo madvise > /sys/kernel/mm/transparent_hugepage/enabled; boot with transparent_hugepage=madvise"
    )
    return Finding("transparent huge pages", LACKING, mode[1], why, remedy)


def check_swap(root: Path) -> Finding:
    """Whether memory may be written to a disk."""
    why = "what is not locked may lie on a disk, and takes milliseconds to read back"
    text = read_text(root / "proc/swaps")
    if text is None:
        return Finding("swap", UNKNOWN, "/proc/swaps cannot be read", why)
    used_kib = [int(line.split()[3]) for line in text.splitlines()[1:] if len(line.split()) >= 4]
    if not used_kib:
        return Finding("swap", GOOD, "none", why)
    found = f"{len(used_kib)} in use, {sum(used_kib) / 1024:.0f} MiB on it"
    state = LACKING if sum(used_kib) else FAIR
    return Finding("swap", state, found, why, "swapoff -a, and remove it from /etc/fstab")
