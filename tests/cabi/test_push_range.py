"""Ranges that clients in Python and C push are the distances of a service with an external driver."""

from __future__ import annotations

import contextlib
import math
import os
import random
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cabi.running import Probe
from hanging_socket import MANNERS, hanging
from raw_slot import raw_slot
from running_service import POSE, Service, config_text, said, until
from surffollow.client import Client, attach
from surffollow.errors import BusyError, NotRunningError, ReadingError, RefusedError
from surffollow.record.replay import replay_file
from surffollow.record.session import record_service
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls

CHANNELS = 3
RANGE_TIME, ARGUMENT, OBSERVER, ENDED = -9, -1, -26, -20
HELD, NO_CHANNEL = -100 - lb.ERR_RANGE_HELD, -100 - lb.ERR_NO_CHANNEL
DRIVER = f'range_min_m = "50 mm"\nrange_max_m = "300 mm"\nchannels = {CHANNELS}'
PUSHING = """
import sys, time
from surffollow.client import attach
from surffollow.errors import NotRunningError
client = attach(sys.argv[1], label="pusher")
while True:  # on a busy machine the service may answer late
    try:
        client.push_range(2, time.monotonic_ns(), 0.2)
        break
    except NotRunningError:
        time.sleep(0.01)
print("pushes", flush=True)
while True:
    client.push_range(2, time.monotonic_ns(), 0.2)
    time.sleep(0.001)
"""


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose ranges come from clients."""
    with Service(
        tmp_path_factory.mktemp("outside"), config_text(kind="external", driver=DRIVER)
    ).running() as s:
        yield s


@pytest.fixture
def client(outside: Service) -> Iterator[Client]:
    with attach(outside.name, stale_min_s=1.0, label="laser") as c:
        yield c


def push_until(client: Client, condition: Callable[[], Any], range_m: float | None, channel: int = 0) -> Any:
    """Push one range and the pose again and again until the condition holds."""

    def step() -> Any:
        client.ee_pos(POSE)
        client.push_range(channel, time.monotonic_ns(), range_m)
        return condition()

    return until(step, "it")


def is_near(found: float, expected: float) -> bool:
    return abs(found - expected) < 0.6e-6


def test_what_python_pushes_is_the_distance_to_the_micrometre_and_none_ends_it(client: Client) -> None:
    push_until(client, lambda: is_near(client.raw_distance(), 0.1234567), 0.1234567)
    push_until(client, lambda: (d := client.dev_vector()).valid and d[2] < 0.0, 0.1234567)  # 0.1 m is wanted
    push_until(client, lambda: math.isnan(client.raw_distance()), None)
    push_until(client, lambda: is_near(client.raw_distance(), 0.2), 0.2)
    push_until(client, lambda: math.isnan(client.raw_distance()), 0.4)  # beyond the window: a loss


def test_what_c_pushes_is_the_distance(
    make_probe: Callable[..., Probe], outside: Service, client: Client
) -> None:
    probe = make_probe()
    assert probe(f"attach {outside.name}").result == 0

    def seen(line: str, met: Callable[[float], bool]) -> None:
        def step() -> bool:
            client.ee_pos(POSE)
            assert probe(line).result == 0
            return met(client.raw_distance(1))

        until(step, line)

    seen("push 1 0.2345678 0", lambda r: is_near(r, 0.2345678))
    seen("push_none 1", math.isnan)
    assert probe("push 1 0.1 2000000").result == RANGE_TIME
    assert probe("push 1 0.1 -1100000000").result == RANGE_TIME
    assert probe("push 1 0.1 -900000000").result == RANGE_TIME  # before the last one
    assert probe("push 8 0.1 0").result == ARGUMENT
    no_such = probe(f"push {CHANNELS} 0.1 0")
    assert (no_such.result, no_such.detail) == (NO_CHANNEL, CHANNELS)
    watcher = make_probe()
    assert watcher(f"observe {outside.name}").result == 0
    assert watcher("push 1 0.1 0").result == OBSERVER


def test_a_channel_has_one_client_until_it_lets_go(
    make_probe: Callable[..., Probe], outside: Service, client: Client
) -> None:
    # GIVEN a channel of a Python client, and another one of a C client
    client.push_range(0, time.monotonic_ns(), 0.1)
    probe = make_probe()
    probe(f"attach {outside.name}")
    # WHEN either pushes into the other's channel, THEN it is refused by the holder's pid
    refused = probe("push 0 0.1 0")
    assert (refused.result, refused.detail) == (HELD, client.status()["clients"][0]["pid"])
    assert probe("claim_range 1").result == 0  # another channel is free
    with pytest.raises(BusyError, match=f"pid {probe.pid}"):
        client.push_range(1, time.monotonic_ns(), 0.1)
    assert f"channel 0 by pid {refused.detail}, 1 by pid {probe.pid}" in until(
        lambda: (text := outside.run("status").stdout) and f"1 by pid {probe.pid}" in text and text
    )
    # WHEN one lets go, THEN the other may push
    client.release_range(0)
    assert probe("claim_range 0").result == 0
    assert probe("push 0 0.1 0").result == 0
    assert probe("release_range 0").result == 0
    client.push_range(0, time.monotonic_ns(), 0.1)


def test_a_killed_client_frees_its_channel(outside: Service, client: Client) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", PUSHING, outside.name],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        # GIVEN a process that pushes ranges
        assert said(child) == "pushes"
        with pytest.raises(BusyError, match=f"pid {child.pid}"):
            client.claim_range(2)
    finally:
        # WHEN it is killed
        child.kill()
        child.communicate()

    def free() -> bool:
        try:
            client.push_range(2, time.monotonic_ns(), 0.15)
        except BusyError:
            return False
        return True

    # THEN another client may push into its channel
    until(free, "a free channel")
    push_until(client, lambda: is_near(client.raw_distance(2), 0.15), 0.15, 2)


@pytest.mark.parametrize(
    ("channel", "ahead_ns", "range_m", "says"),
    [
        (8, 0, 0.1, "channel 8"),
        (-1, 0, 0.1, "channel -1"),
        (0.5, 0, 0.1, "channel must be a whole number"),
        (0, 10**9, 0.1, "in the future"),
        (0, -2 * 10**9, 0.1, "old"),
        (0, -50_000_000, 0.1, "times must ascend"),
        (0, 0, "0.1", "a number of metres or None"),
    ],
)
def test_what_cannot_be_a_range_is_reported_at_once(
    client: Client, channel: Any, ahead_ns: int, range_m: Any, says: str
) -> None:
    now_ns = time.monotonic_ns()
    client.push_range(0, now_ns, 0.1)
    with pytest.raises(ReadingError, match=says):
        client.push_range(channel, now_ns + 1000 + ahead_ns, range_m)


def test_channels_that_the_driver_has_not_are_refused(client: Client) -> None:
    with pytest.raises(RefusedError, match=f"has {CHANNELS} channels"):
        client.push_range(CHANNELS, time.monotonic_ns(), 0.1)


def test_a_service_with_another_driver_takes_no_ranges(service: Any) -> None:
    with (
        attach(service.name, stale_min_s=1.0) as c,
        pytest.raises(RefusedError, match="another kind of driver"),
    ):
        c.push_range(0, time.monotonic_ns(), 0.1)


class Scribbler:
    """Claims a channel as a client does, then writes what it likes into its ring until it is closed."""

    def __init__(self, name: str, seed: int) -> None:
        self.socket, _, self.memory, _ = raw_slot(name)
        self.rng, self.random = np.random.default_rng(seed), random.Random(seed)
        self.words = np.frombuffer(self.memory, np.int64)
        self.post(lb.RQ_CLAIM_RANGE, 1)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._scribble)
        self._thread.start()

    def post(self, code: int, channel: int) -> None:
        at = ls.SLOT_REQUEST + 64 + 320
        body = struct.pack("<4q16q16d", 1, code, 1, 0, channel, *[0] * 15, *[0.0] * 16)
        self.memory[at : at + len(body)] = body
        self.words[ls.SLOT_REQUEST // 8] = 1

    def _scribble(self) -> None:
        head, first = ls.SLOT_RANGES // 8, (ls.SLOT_RANGES + ls.RANGES_AT) // 8
        n = ls.RANGE_ITEMS * 4
        while not self._over.is_set():
            kind = self.random.randrange(4)
            if kind == 0:
                self.words[first : first + n] = self.rng.integers(-(2**62), 2**62, n)
            elif kind == 1:  # items that look right, for every channel, with times around now
                numbers = int(self.words[head]) + 1 + np.arange(ls.RANGE_ITEMS)
                items = self.words[first : first + n].reshape(-1, 4)
                items[numbers - 1 & ls.RANGE_ITEMS - 1, 0] = numbers
                items[:, 1] = time.monotonic_ns() + self.rng.integers(-(10**10), 10**10, ls.RANGE_ITEMS)
                items[:, 2] = self.rng.integers(-2, 5, ls.RANGE_ITEMS)
                items[:, 3] = np.full(ls.RANGE_ITEMS, 0.07).view(np.int64)
            steps = (0, 1, 5, 63, 64, 127, 128, 129, 10**6, -1, 2**62, -(2**62))
            self.words[head] = (int(self.words[head]) + self.random.choice(steps)) % 2**63

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.socket.close()


@pytest.mark.parametrize("seed", [1, 2])
def test_rubbish_in_one_ring_never_moves_a_distance_of_another(
    outside: Service, client: Client, seed: int
) -> None:
    # GIVEN a client that pushes, and one that writes rubbish into the ring of another channel
    push_until(client, lambda: is_near(client.raw_distance(), 0.25), 0.25)
    before = client.status()
    attacker = Scribbler(outside.name, seed)
    try:
        until(lambda: client.status()["main"]["range_slot"][1] >= 0, "the claim")
        # WHEN both go on until hundreds of ranges were refused
        wrong: list[float] = []

        def step() -> bool:
            client.ee_pos(POSE)
            client.push_range(0, time.monotonic_ns(), 0.25)
            if not is_near(found := client.raw_distance(), 0.25) and not math.isnan(found):
                wrong.append(found)
            now = client.status()
            return (
                now["ranges_refused"] - before["ranges_refused"] > 300
                and now["cycles"] - before["cycles"] > 300
                and "pushed ranges were refused" in now["main"]["text"]
            )

        until(step, "refusals")
    finally:
        attacker.close()
    # THEN the first one's distance was never another
    assert wrong == []
    # WHEN the attacker is gone, THEN its channel is free
    until(lambda: client.status()["main"]["range_slot"][1] == -1, "a free channel")
    push_until(client, lambda: is_near(client.raw_distance(), 0.26), 0.26)


def test_a_run_with_pushed_ranges_replays_bit_for_bit(
    outside: Service, client: Client, tmp_path: Path
) -> None:
    # GIVEN a recording of a client that pushes ranges and losses
    path, done = tmp_path / "run.mcap", threading.Event()
    # a snapshot, from which a replay begins, is written once in a second
    options = {"seconds": 2.5, "rate_hz": 0}
    recorder = threading.Thread(target=record_service, args=(outside.name, path, done), kwargs=options)
    recorder.start()
    rng = random.Random(5)
    try:
        while recorder.is_alive():
            push_until(client, lambda: True, rng.choice([0.1, None, rng.uniform(0.04, 0.32)]))
            done.wait(0.001)  # ranges at about 1 kHz
    finally:
        done.set()
        recorder.join()
    # WHEN it is replayed, THEN its bits are the same
    report = replay_file(path)
    assert report.identical, report
    assert report.cycles > 200


def test_a_client_goes_on_pushing_to_a_restarted_service(outside: Service, client: Client) -> None:
    # GIVEN a client that pushes
    push_until(client, lambda: is_near(client.raw_distance(), 0.11), 0.11)
    # WHEN the service is killed and started again
    outside.kill()
    outside.start()

    def step() -> bool:
        with contextlib.suppress(NotRunningError):  # while it is silent
            client.push_range(0, time.monotonic_ns(), 0.13)
            client.ee_pos(POSE)
        return is_near(client.raw_distance(), 0.13)

    # THEN its ranges are taken there
    until(step, "the new service")


def test_pose_and_channels_of_ranges_are_claimed_anew_in_steps_whichever_call_comes_first(
    outside: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN a C client that sends the pose and ranges
    probe = make_probe()
    assert probe(f"attach {outside.name}").result == 0
    calls = ("ee 0.05 0.05 0.1 0 0 0 1", "push 0 0.1 0", "push 1 0.1 0")
    for call in calls:
        probe.until(call, lambda a: a.result == 0)
    # WHEN the service is started again and its socket hangs
    outside.kill()
    probe.until(calls[0], lambda a: a.result == ENDED)
    outside.start()
    with hanging(outside.name, MANNERS[0]):
        # THEN no call waits for it
        slow = 0
        for k in range(100):
            began = time.monotonic()
            assert probe(calls[k % 3]).result == ENDED
            probe("dev")
            slow += time.monotonic() - began > 0.1
        assert slow < 10, "one waiting exchange takes a second"
    # WHEN the socket answers, THEN the client has all that it had
    until(lambda: [probe(call).result for call in calls] == [0, 0, 0], "pose and ranges")


def test_no_call_waits_and_few_ask_while_another_client_pushes_the_channel(
    outside: Service, client: Client, make_probe: Callable[..., Any]
) -> None:
    probe = make_probe()
    assert probe(f"attach {outside.name}").result == 0
    client.claim_range(1)
    with attach(outside.name, stale_min_s=1.0, label="second") as second:
        for pid, push in (
            (probe.pid, lambda: probe("push 1 0.2 0").result == -100 - lb.ERR_RANGE_HELD),
            (os.getpid(), lambda: is_refused(second)),
        ):
            # GIVEN a client that was refused WHEN it goes on calling, THEN it is refused each time
            began_s, before = time.monotonic(), refusals_of(client, pid)
            assert all(push() for _ in range(300))
            # THEN the service was asked a few times at first, and then once a second at most
            asked = until(lambda pid=pid, n=before: refusals_of(client, pid) - n, "the audit")
            assert asked <= 6 + (time.monotonic() - began_s)
    client.release_range(1)
    probe.until("push 1 0.2 0", lambda a: a.result == 0)


def is_refused(client: Client) -> bool:
    """Whether a range is refused."""
    try:
        client.push_range(1, time.monotonic_ns(), 0.2)
    except BusyError:
        return True
    return False


def refusals_of(client: Client, pid: int) -> int:
    """How often a process was refused a channel."""
    entries = [e for e in client.audit() if e["pid"] == pid and e["request"] == "claim_range"]
    return sum(e["count"] for e in entries if not e["accepted"])
