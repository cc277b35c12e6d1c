"""An arbiter against its limits: latency, rates, an idle server, kills, attacks.

times     grant beside a Unix-socket round trip between two such processes, in turns, in C and in Python, once
          with the two on one processor and once on two (waking another processor takes longest);
          one command, in C and in Python; commands forwarded per second; an idle server's processor time
kills     holders, requesters and servers killed or stopped at random moments; an independent program audits
          the history meanwhile (tools/arbiter_audit.py)
attacks   a client that scribbles over its mailbox, forges tokens, holds locks, floods; meanwhile an honest
          client with a higher priority asks, commands and relinquishes

    python tools/bench_arbiter.py [--kills 1000] [--attack-seconds 5] [--seed 91] [--json]
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import fcntl
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from arbiter_trials import LEASE_S, PERIOD_S, Nursery, Trials, audited, end, fork
from report import criterion, finish, result
from surffollow.arbiter import attach
from surffollow.arbiter import exchange as ex
from surffollow.arbiter import layout as al

ROOT = Path(__file__).parents[1]
SCHEDULING_S = 0.1  # a busy machine's, on top of lease and period


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def quantile(values: list[float], part: float) -> float:
    values = sorted(values)
    return values[min(len(values) - 1, int(part * len(values)))] if values else float("nan")


@contextlib.contextmanager
def placed(server: int, cpu: int) -> Iterator[None]:
    """This process and its children on the first processor, the server on `cpu`."""
    before = os.sched_getaffinity(0)
    tasks = [int(t.name) for t in Path(f"/proc/{server}/task").iterdir()]
    try:
        for task in tasks:
            os.sched_setaffinity(task, {cpu})
        os.sched_setaffinity(0, {min(before)})
        yield
    finally:
        os.sched_setaffinity(0, before)
        for task in tasks:
            os.sched_setaffinity(task, before)


def c_times(name: str, rounds: int, cpu: int) -> dict[str, float]:
    """Output of tools/arbiter_timing.c."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "timing"
        source = ROOT / "tools/arbiter_timing.c"
        subprocess.run(
            ["gcc", "-std=c11", "-O2", f"-I{ROOT / 'include'}", "-o", str(program), str(source)], check=True
        )
        words = subprocess.run(
            [str(program), name, "avoid", str(rounds), str(cpu)], check=True, capture_output=True, text=True
        ).stdout.split()
    return {words[k]: float(words[k + 1]) for k in range(0, len(words), 2)}


def python_times(name: str, rounds: int, cpu: int) -> dict[str, float]:
    """The same from Python; the other end of the socket is Python, too."""
    here, there = socket.socketpair()

    def echo(_: int) -> None:
        os.sched_setaffinity(0, {cpu})
        while there.send(there.recv(1)):
            pass

    pid, r = fork(echo)
    sock, grant, command = [], [], []
    with attach(name, "wall") as one:
        robot = one.resource("robot")
        for _ in range(rounds):
            begin = time.perf_counter_ns()
            here.send(b"x")
            here.recv(1)
            sock.append(time.perf_counter_ns() - begin)
            begin = time.perf_counter_ns()
            robot.request()
            grant.append(time.perf_counter_ns() - begin)
            robot.relinquish()
        robot.request()
        for k in range(4 * rounds):
            begin = time.perf_counter_ns()
            robot.command(0.1, 0.2)
            command.append(time.perf_counter_ns() - begin)
            if k % 32 == 31:
                time.sleep(0.003)
    end(pid, r)
    return {
        "python_socket_p50_ns": quantile(sock, 0.5),
        "python_grant_p50_ns": quantile(grant, 0.5),
        "python_command_p50_ns": quantile(command, 0.5),
    }


def idle_share(pid: int, seconds: float = 4.0) -> float:
    """Part of a processor that the server takes while nobody holds anything."""

    def ticks() -> int:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return int(words[11]) + int(words[12])

    before, start = ticks(), time.monotonic()
    time.sleep(seconds)
    return (ticks() - before) / os.sysconf("SC_CLK_TCK") / (time.monotonic() - start)


# -- attacks ------------------------------------------------------------------------------------------


def post(one: Any, what: int, token: int, seq: int | None = None) -> None:
    """Put an item into the mailbox, whatever the library would say."""
    words = one.exchange.mailbox_words
    head = words[ex.HEAD]
    at = ex.ITEMS + (head & ex.MASK) * ex.ITEM_BYTES
    numbers = (head + 1 if seq is None else seq, what, token, time.monotonic_ns(), 0)
    ex.COMMAND.pack_into(one.exchange.mailbox, at, *numbers, *(0.4,) * al.VALUES)
    words[ex.HEAD] = head + 1


def scribble(one: Any, rng: random.Random) -> None:
    words = one.exchange.mailbox_words
    for _ in range(200):
        words[rng.randrange(len(words))] = rng.choice((0, -1, 1, 1 << 62, rng.getrandbits(62)))


def forge(one: Any, rng: random.Random) -> None:
    token = one.board.status(0)["token"]
    for forged in (token, token + 1, token - 1, token ^ (1 << 32), rng.getrandbits(62), 0):
        post(one, al.ITEM_COMMAND, forged, one.exchange.mailbox_words[ex.HEAD] + 1)


def flood(one: Any, rng: random.Random) -> None:
    for _ in range(32):
        what = rng.choice((al.ITEM_REQUEST, al.ITEM_RELINQUISH, al.ITEM_REQUEST | al.FLAG_WAIT << 16, 99))
        post(one, what | rng.choice((0, 0, 77)) << 8, 0)
        one.exchange.mailbox_words[ex.DOORBELL] = rng.getrandbits(31)
        one.exchange.wake_server()


def lock(one: Any, rng: random.Random) -> None:
    """Every lock that another user who may read can take, on everything that bears the arbiter's name."""
    if os.geteuid() == 0:
        os.setuid(65534)  # the server's own user can do anything to it; that is not the attack
    shared = struct.pack("hhqqi4x", fcntl.F_RDLCK, 0, 0, 0, 0)
    for path in Path("/dev/shm").glob(f"{one.name}*"):
        try:
            fd = os.open(path, os.O_RDONLY)
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, shared)
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
            held.append(fd)
        except OSError:
            continue
    time.sleep(0.05)


held: list[int] = []
ATTACKS: dict[str, Callable[[Any, random.Random], None]] = {
    "scribbles": scribble,
    "forges": forge,
    "floods": flood,
    "locks": lock,
}


def attacker(name: str, attack: Callable[[Any, random.Random], None], seed: int) -> Callable[[int], None]:
    def work(w: int) -> None:
        one, rng = attach(name, "attacker"), random.Random(seed)
        os.write(w, struct.pack("<q", one.number))
        while True:
            attack(one, rng)
            one.resource("robot")

    return work


def measure_attack(nursery: Nursery, what: str, seconds: float, seed: int) -> dict[str, Any]:
    """One attack: how long an honest client waited at most, and what the audit says of the attacker."""
    nursery.restart()  # the audit reads a history from its beginning
    longest, grants = 0.0, 0
    with audited(nursery.name) as found:
        pid, r = fork(attacker(nursery.name, ATTACKS[what], seed))
        (number,) = struct.unpack("<q", os.read(r, 8))
        with attach(nursery.name, "avoid") as one:
            robot, begin = one.resource("robot"), time.monotonic()
            while time.monotonic() - begin < seconds:
                start = time.monotonic()
                reply = robot.request(timeout_s=5.0)
                longest = max(longest, time.monotonic() - start)
                assert reply, reply
                for _ in range(5):
                    robot.command(0.1, 0.1)
                    time.sleep(0.001)
                robot.relinquish()
                grants += 1
        end(pid, r)
        if what == "locks":  # a server that ends while a reader holds locks is replaced at once
            pid, r = fork(attacker(nursery.name, ATTACKS[what], seed))
            os.read(r, 8)
            time.sleep(0.2)
            nursery.kill()
            start = time.monotonic()
            nursery.start()
            longest = max(longest, time.monotonic() - start)
            end(pid, r)
    of = found["forwarded_of"].get(str(number), 0)
    return {"longest_s": longest, "grants": grants, "forwarded_of_attacker": of} | found


def main() -> dict[str, Any]:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--attack-seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--json", action="store_true")
    words = parser.parse_args()
    ctypes.CDLL(None)  # loaded before the first fork
    nursery = Nursery(f"bench-{os.getpid()}")
    criteria, figures = [], {}
    try:
        pid = nursery.start()
        figures["times"] = {}
        first, last = min(os.sched_getaffinity(0)), max(os.sched_getaffinity(0))
        for where, cpu in {"one processor": first, "two processors": last}.items():
            with placed(pid, cpu):
                times = c_times(nursery.name, words.rounds, cpu)
                times |= python_times(nursery.name, words.rounds, cpu)
            figures["times"][where] = times
            for language, mark in (("C", ""), ("Python", "python_")):
                grant, trip = times[f"{mark}grant_p50_ns"], times[f"{mark}socket_p50_ns"]
                note = f"{grant / 1e3:.1f} of {trip / 1e3:.1f} us"
                what = f"grant / socket round trip, p50, {language}, {where}"
                criteria.append(criterion(what, grant / trip, 1.0, "", note))
        criteria.append(criterion("command, C, p50", times["command_p50_ns"], 60.0, "ns"))
        criteria.append(criterion("command, Python, p50", times["python_command_p50_ns"] / 1e3, 2.0, "us"))
        rate = times["forwarded_per_s"]
        criteria.append(
            criterion("1e6 / commands forwarded per second", 1e6 / rate, 50.0, "", f"{rate:.0f} per s")
        )
        share = idle_share(pid)
        criteria.append(criterion("idle server, part of a processor", share, 0.03, ""))
        say("times taken")
        attacks = {}
        for what in ATTACKS:
            attacks[what] = got = measure_attack(nursery, what, words.attack_seconds, words.seed)
            note = f"{got['grants']} grants meanwhile"
            criteria.append(criterion(f"attacker {what}: longest wait", got["longest_s"], LEASE_S, "s", note))
            forged = got["forwarded_of_attacker"] if what == "forges" else 0
            criteria.append(criterion(f"attacker {what}: violations", len(got["violations"]) + forged, 0, ""))
            say(f"attack: {what}")
        figures["attacks"] = attacks
        nursery.restart()
        trials = Trials(nursery, words.seed)
        with audited(nursery.name) as found:
            trials.run(words.kills, say)
        figures["audit"] = found
        limit = LEASE_S + PERIOD_S + SCHEDULING_S
        for kind, values in trials.times_s.items():
            note = f"{len(values)} trials, p50 {quantile(values, 0.5) * 1e3:.1f} ms"
            criteria.append(
                criterion(f"{kind}: safe and free after", max(values, default=None), limit, "s", note)
            )
        note = f"{found['records']} records, {found['forwarded']} forwarded, {found['servers']} servers"
        criteria.append(
            criterion("violations found by the audit", len(found["violations"]) + found["lost"], 0, "", note)
        )
        criteria.append(
            criterion("hangs and unusable resources", len(trials.hangs), 0, "", "; ".join(trials.hangs[:3]))
        )
    finally:
        nursery.close()
    notes = [
        f"the limit of a kill is lease + period + {SCHEDULING_S:g} s of scheduling",
        f"seed {words.seed}",
    ]
    return result("arbiter", criteria, notes, **figures)


if __name__ == "__main__":
    sys.exit(finish(main()))
