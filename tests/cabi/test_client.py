"""C and C++ clients of a real service: poses, demands, requests and refusals."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Iterator

import pytest

from cabi.running import PATIENT_MS, Answer, Probe
from running_service import STANDOFF_M, Service, until
from second_user import needs_root
from surffollow.client import STALE, Client, Demand, observe
from surffollow.client import attach as attach_hasty
from surffollow.client.attachment import stale_age_ns
from surffollow.config.names import OBJECTS
from surffollow.config.params import PARAMS, UNIT_ENDINGS
from surffollow.errors import BusyError, RefusedError
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import NO_POSE, POSE_STALE, VALID

OK, NO_DEMAND, PENDING, NO_READING = 0, 1, 2, 3
POSE = "ee 0.05 0.05 0.1 0 0 0 1"


def attach(name: str, label: str = "") -> Client:
    """A Python client as patient as the probes."""
    return attach_hasty(name, label=label, stale_min_s=PATIENT_MS / 1000)


@pytest.fixture
def probe(make_probe: Callable[..., Probe], service: Service) -> Probe:
    """A probe attached to the folder's service."""
    p = make_probe()
    assert p(f"attach {service.name}").result == OK
    return p


def test_names_that_no_service_can_have_are_refused_before_any_file_is_opened(
    make_probe: Callable[..., Probe],
) -> None:
    probe = make_probe()
    for name in ("../etc/passwd", "a/b", ".hidden", "x" * 49, "a b", "ä"):
        assert probe(f"observe {name}").result == (-20 if name == "a b" else -2), name
    assert probe(f"observe {'x' * 48}").result == -20
    for last in OBJECTS:
        for how in ("attach", "observe"):
            assert probe(f"{how} surf.{last}").result == -2, "an object of the service surf"
        assert probe(f"observe surf{last}").result == -20
        assert probe(f"observe surf.{last}s").result == -20
        assert probe(f"observe {last}").result == -20
    assert probe("dev").result == -1


@pytest.mark.parametrize(("stale_ms", "result"), [(86_400_000, OK), (86_400_001, -1), (9e12, -1), (-1, -1)])
def test_no_client_takes_demands_for_valid_for_more_than_a_day(
    make_probe: Callable[..., Probe], service: Service, stale_ms: float, result: int
) -> None:
    for how in ("attach", "observe"):
        assert make_probe(stale_ms)(f"{how} {service.name}").result == result, how


def test_demand_is_the_one_that_the_python_client_reads(probe: Probe, service: Service) -> None:
    assert probe(f"reset {STANDOFF_M}").result == OK
    with observe(service.name) as watcher:

        def both() -> tuple[Answer, Demand] | None:
            assert probe(POSE).result == OK
            c, python = probe("dev"), watcher.dev_vector()
            # neither process was put to sleep between the two reads
            alike = c.result == OK and python.valid and int(c.values[2]) == python.status
            return (c, python) if alike and 0 <= c.values[4] < 20e6 else None

        c, python = until(both, "one demand seen by both")
        assert int(c.values[2]) & VALID
        assert c.values[3] == python.epoch
        assert c.values[0] == pytest.approx(python[2], abs=1e-3)
        python_m = until(lambda: (d := watcher.raw_distance()) > 0.0 and d, "a distance")
    c_m = probe.until("raw 0", lambda a: a.result == OK).values[0]
    # two readings of a sensor with 0.25 mm of noise: six deviations of their difference
    assert c_m == pytest.approx(python_m, abs=2.2e-3)
    assert c_m == pytest.approx(STANDOFF_M, abs=1e-3)


def test_channel_without_a_sensor_gives_no_reading(probe: Probe) -> None:
    answer = probe("raw 5")
    assert answer.result == NO_READING
    assert math.isnan(answer.values[0])
    assert probe("raw 8").result == probe("raw -1").result == -1


@pytest.mark.parametrize(
    ("pose", "result"),
    [
        ("ee 0 0 nan 0 0 0 1", -3),
        ("ee 0 inf 0 0 0 0 1", -3),
        ("ee 0 0 0 0 0 0 0", -3),
        ("ee 0 0 0 0 0 0 1.0011", -3),
        ("ee 0 0 0 0 0 0 0.9989", -3),
        ("ee 0 0 0 0 0 0 1e200", -3),
        ("ee 0 -2e9 0 0 0 0 1", -3),
        ("ee 0.05 0.05 0.1 0 0 0 1.0009", OK),
        ("ee_at 0 0 0 0 0 0 1 5000000", -4),
        ("ee_at 0 0 0 0 0 0 1 -120000000", -5),
        ("ee_at 0.05 0.05 0.1 0 0 0 1 -1000000", OK),
    ],
)
def test_pose_is_checked_as_the_python_client_does(probe: Probe, pose: str, result: int) -> None:
    assert probe(pose).result == result


def test_second_sender_of_the_pose_is_refused_with_the_holders_pid(
    probe: Probe, make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a C client that holds the pose
    assert probe("claim").result == OK
    # WHEN another one, in C or in Python, sends it, THEN it is refused by the holder's pid
    other = make_probe()
    other(f"attach {service.name}")
    refused = other(POSE)
    assert (refused.result, refused.detail) == (-100 - lb.ERR_POSE_HELD, probe.pid)
    with attach(service.name) as robot, pytest.raises(BusyError, match=f"pid {probe.pid}"):
        robot.ee_pos((0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
    # WHEN the holder lets go, THEN the other may, at once when it claims the pose
    assert probe("release").result == OK
    assert other("claim").result == OK
    assert other(POSE).result == OK


def test_pose_of_a_killed_sender_is_free_again(
    probe: Probe, make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a C client that sends the pose
    assert probe(POSE).result == OK
    # WHEN it is killed, THEN another one may send it
    probe.process.kill()
    probe.process.wait()
    other = make_probe()
    other(f"attach {service.name}")
    other.until(POSE, lambda a: a.result == OK)


def test_child_that_forgot_its_parents_client_does_not_keep_the_slot(
    probe: Probe, make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a client that sends the pose and has a forked child
    assert probe(POSE).result == OK
    assert probe("fork 20000").result == OK
    assert probe(POSE).result == OK
    # WHEN the client is killed, THEN another one may send the pose though the child lives
    probe.process.kill()
    probe.process.wait()
    other = make_probe()
    other(f"attach {service.name}")
    other.until(POSE, lambda a: a.result == OK, 10.0)  # long before the child ends


def test_parameters_set_in_c_are_read_in_python_and_the_other_way_round(
    probe: Probe, service: Service
) -> None:
    assert probe("set range_size 7").result == OK
    assert probe("set interval_size 0.003").result == OK
    with attach(service.name) as robot:
        assert robot.params()["range_size"] == 7
        assert robot.params()["interval_size_m"] == 0.003
        robot.set_params(range_size=5, interval_size="2 mm")
    assert probe("get range_size").values == [5.0]
    assert probe("get interval_size_m").values == [0.002]


@pytest.mark.parametrize(
    ("line", "result"),
    [
        ("set nosuch 1", -7),
        ("set interval 1", -7),
        ("get n_channels", -7),
        ("set range_size 2.5", -8),
        ("set range_size 0", -8),
        ("set offset -1", -8),
        ("set offset nan", -8),
        ("reset -1", -100 - lb.ERR_BAD_VALUE),
        ("reset nan", -100 - lb.ERR_BAD_VALUE),
        ("release", OK),
        ("wait 10", -1),
    ],
)
def test_what_cannot_be_is_refused_with_its_reason(probe: Probe, line: str, result: int) -> None:
    assert probe(line).result == result


def test_unknown_request_is_answered(probe: Probe) -> None:
    assert probe("send 77 0").result == OK
    answer = probe.until("poll", lambda a: a.result != PENDING)
    assert answer.result == -100 - lb.ERR_UNKNOWN_REQUEST


@contextlib.contextmanager
def stopped(service: Service) -> Iterator[None]:
    """The service stands still, every thread of it."""
    service.freeze()
    try:
        yield
    finally:
        service.send(signal.SIGCONT)


def test_request_cannot_overtake_one_that_the_service_has_not_seen(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a patient client, and a service that stands still
    patient = make_probe()
    patient("stale_ms 60000")
    assert patient(f"attach {service.name}").result == OK
    with stopped(service):
        assert patient(f"send {lb.RQ_SF_RESET} 0.11").result == OK
        # WHEN it sends a second request, THEN that is refused, and the first is still to be answered
        assert patient(f"send {lb.RQ_SF_RESET} 0.12").result == -29
        assert patient("poll").result == PENDING
        assert patient("wait 30").result == -27
    # WHEN the service goes on, THEN the first request is carried out
    patient.until("poll", lambda a: a.result == OK)  # carried out after all
    assert patient("get offset").values == [0.11]
    assert patient(f"reset {STANDOFF_M}").result == OK


def test_stopped_service_is_silent_and_its_demand_is_zero(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a client of a service that stands still
    probe = make_probe()
    probe("timeout_ms 300")
    assert probe(f"attach {service.name}").result == OK
    with stopped(service):
        # THEN its demand is zero and stale, and its requests are refused
        silent = probe.until("dev", lambda a: int(a.values[2]) & STALE != 0)
        assert silent.result == NO_DEMAND
        assert not int(silent.values[2]) & VALID
        assert silent.values[:2] == [0.0, 0.0]
        assert math.isnan(probe("raw 0").values[0])
        for line in (f"reset {STANDOFF_M}", "begin 10", "map_reset 0 0 1 1"):
            assert probe(line).result == -20, line
    # WHEN the service goes on, THEN requests are answered
    probe.until("alive", lambda a: a.result == 1)
    probe.until(f"reset {STANDOFF_M}", lambda a: a.result == OK)


@pytest.mark.parametrize("line", [f"reset {STANDOFF_M}", "begin 60000", "map_reset 0 0 0.1 0.1"])
def test_request_outlasts_a_stall_shorter_than_its_time(probe: Probe, service: Service, line: str) -> None:
    with stopped(service):
        probe.until("alive", lambda a: a.result == 0)
        probe.ask(line)
    assert probe.answer(line).result == OK
    probe("end")


def test_signals_do_not_disturb_any_call(probe: Probe) -> None:
    probe("interrupt")
    for _ in range(20):
        assert probe(POSE).result == OK
        assert probe(f"reset {STANDOFF_M}").result == OK
        assert probe("set range_size 5").result == OK
        assert probe("dev").result in (OK, NO_DEMAND)
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    assert probe("begin 60000").result == OK
    assert probe("end").result == OK


def test_status_names_the_pose_sender_and_counts(probe: Probe, service: Service) -> None:
    assert service.process is not None
    probe(POSE)
    answer = probe.until("status", lambda a: a.values[3] == probe.pid)
    alive, pid, cycles, _, _, clients, _ = answer.values
    assert (alive, pid) == (1, service.process.pid)
    assert clients >= 1
    assert probe("status").values[2] >= cycles


def test_seventeenth_client_learns_that_the_slots_are_taken(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN as many clients as there are slots
    probes = []
    while (probe := make_probe())(f"attach {service.name}").result == OK:
        probes.append(probe)
        assert len(probes) <= lb.CLIENTS
    # WHEN one more attaches, THEN it is refused
    assert probe(f"attach {service.name}").result == -25
    assert len({p("alive").slot for p in probes}) == len(probes) == lb.CLIENTS
    # WHEN one is killed, THEN the next one gets its slot
    probes[3].process.kill()
    probes[3].process.wait()
    assert probe(f"attach {service.name}").result == OK
    assert probe("alive").slot == 3


def test_c_client_takes_the_slot_next_to_a_python_client(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    with attach(service.name, label="python") as robot:
        probe = make_probe()
        assert probe(f"attach {service.name}").slot != robot.slot
        with pytest.raises(RefusedError, match="bounds"):
            robot._request(lb.RQ_SF_RESET, values=(-1.0,)).result()
        assert probe("reset -1").result == -100 - lb.ERR_BAD_VALUE


def test_observer_sees_demands_but_cannot_send(make_probe: Callable[..., Probe], service: Service) -> None:
    probe = make_probe()
    assert probe(f"observe {service.name}") == (OK, 0, -1, [])
    probe.until("alive", lambda a: a.result == 1)
    assert int(probe("dev").values[2]) & (VALID | NO_POSE | POSE_STALE)
    for line in (POSE, "reset 0.1", "claim", "set range_size 5", "begin 10", "map_reset 0 0 1 1"):
        assert probe(line).result == -26, line


@needs_root
def test_other_users_are_refused_by_the_kernel_with_the_reason(
    make_probe: Callable[..., Probe], service: Service, tmp_path_factory: pytest.TempPathFactory
) -> None:
    base = tmp_path_factory.getbasetemp()
    for folder in (*base.glob("programs*"), base, *base.parents):
        if folder.name.startswith(("programs", "pytest-", "popen-")):
            folder.chmod(0o755)
    stranger = make_probe(user=65534, group=65534, extra_groups=[])
    assert stranger(f"observe {service.name}").result == -21
    board = f"/dev/shm/{service.name}"
    os.chmod(board, 0o644)
    try:
        assert stranger(f"observe {service.name}").result == OK
        stranger.until("alive", lambda a: a.result == 1)
        assert stranger("height 0 0").result == -24  # the map has its own mode
        stranger("auto 1")
        assert stranger("detach").result == OK
    finally:
        os.chmod(board, 0o640)


def test_link_in_place_of_a_block_is_not_followed(make_probe: Callable[..., Probe], service: Service) -> None:
    link = f"/dev/shm/cabi-link-{os.getpid()}"
    os.symlink(f"/dev/shm/{service.name}", link)
    try:
        assert make_probe()(f"observe {os.path.basename(link)}").result == -24
    finally:
        os.unlink(link)


def test_block_of_another_release_is_refused(make_probe: Callable[..., Probe], service: Service) -> None:
    with open(f"/dev/shm/{service.name}", "rb") as f:
        board = bytearray(f.read())
    at = lb.BoardHeader.offset("layout_hash")
    board[at] ^= 1
    other = f"/dev/shm/cabi-other-{os.getpid()}"
    try:
        with open(other, "wb") as f:
            f.write(board)
        assert make_probe()(f"observe {os.path.basename(other)}").result == -23
        board[at] ^= 1
        with open(other, "wb") as f:
            f.write(board[:8192])  # cut short
        assert make_probe()(f"observe {os.path.basename(other)}").result == -24
        with open(other, "wb") as f:
            f.write(bytes(8192))  # not laid out yet
        started, hasty = time.monotonic(), make_probe()
        hasty("ready_ms 400")
        assert hasty(f"observe {os.path.basename(other)}").result == -22
        assert 0.3 < time.monotonic() - started < 30.0
    finally:
        os.unlink(other)


def test_every_parameter_is_known_without_its_unit_in_c_too(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    probe = make_probe()
    assert probe(f"attach {service.name}").result == OK
    for full in PARAMS:
        short = full[: -len(max((e for e in UNIT_ENDINGS if full.endswith(e)), key=len)) or None]
        assert probe(f"get {short}").result == OK, short
        assert probe(f"get {short}").values == probe(f"get {full}").values
    assert probe("get max_turn_m").result == -7


@pytest.mark.parametrize(
    ("periods", "least_ns", "period_ns", "age_ns"),
    [
        (20, 5_000_000, 1_000_000, 20_000_000),
        (20, 5_000_000, 100_000, 5_000_000),
        (20, 5_000_000, 10_000_000, 100_000_000),
        (20, 5_000_000, 100_000_000, 300_000_000),
        (20, 5_000_000, 1_000_000_000, 3_000_000_000),
        (1, 0, 1_000_000_000, 1_000_000_000),
        (1 << 62, 0, 1_000_000, 100_000_000),
        (20, 10_000_000_000, 1_000_000, 10_000_000_000),
    ],
)
def test_a_demand_of_a_slow_service_is_stale_after_three_periods(
    make_probe: Callable[..., Probe], periods: int, least_ns: int, period_ns: int, age_ns: int
) -> None:
    assert stale_age_ns(periods, period_ns, least_ns) == age_ns
    assert make_probe()(f"stale_of {periods} {least_ns} {period_ns}").values == [age_ns]


def test_no_call_waits_and_few_ask_while_another_client_has_the_pose(probe: Probe, service: Service) -> None:
    with attach(service.name) as driver:
        # GIVEN a Python client with the pose, and a C client that was refused
        driver.claim_pose()
        began_s = time.monotonic()
        refused = probe(POSE)
        # WHEN it goes on calling, THEN it is refused by the same process each time
        for _ in range(300):
            assert probe(POSE)[:2] == refused[:2] == (-100 - lb.ERR_POSE_HELD, os.getpid())
        # THEN the service was asked a few times at first, and then once a second at most
        asked = until(lambda: claims_of(driver, probe.pid), "the audit")
        assert asked <= 6 + (time.monotonic() - began_s)
        # WHEN the pose is free, THEN the C client has it soon
        driver.release_pose()
        probe.until(POSE, lambda a: a.result == OK)


def claims_of(client: Client, pid: int) -> int:
    """How often a process was refused the pose."""
    entries = [e for e in client.audit() if e["pid"] == pid and e["request"] == "claim_pose"]
    return sum(e["count"] for e in entries if not e["accepted"])
