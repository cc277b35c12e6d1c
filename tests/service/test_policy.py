"""Rights to change parameters and the map: [limits], access.parameters, the audit trail."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from running_service import POSE, Service, config_text, objects_of, program, said, until
from second_user import AS_NOBODY, NOBODY, needs_root
from surffollow.client import Client
from surffollow.client.audit import audit_line, printable
from surffollow.config.service import parse_config
from surffollow.errors import BusyError, ConfigError, RefusedError
from surffollow.map.height_map import HeightMap
from surffollow.shm import layout_board as lb

Make = Callable[..., Service]
# a client that tries to change everything dangerous, and says how it fared
OTHER_CLIENT = """
import os, sys
from surffollow.client import attach
from surffollow.errors import SurffollowError
client = attach(sys.argv[1], stale_min_s=1.0, label="other_client\\x1b[2J")
print(os.getpid(), flush=True)
for values in ({"max_demand": 0.05}, {"max_speed": 3.0}, {"pose_timeout": "90 ms"}):
    try:
        client.set_params(**values)
        print("set", flush=True)
    except SurffollowError as e:
        print(getattr(e, "code", -1), e, flush=True)
try:
    client.sf_reset(0.09)
    print("reset", flush=True)
except SurffollowError as e:
    print(getattr(e, "code", -1), e, flush=True)
sys.stdin.readline()
"""
LIMITS = """[limits]
max_demand = { max = "60 mm" }
max_speed = { max = "4 m/s" }
offset = { min = "80 mm", max = "120 mm" }
"""


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with limits, whose objects every user may use."""
    text = config_text(access='board_mode = "0644"\nsocket_mode = "0666"\nmap_mode = "0644"') + LIMITS
    with Service(tmp_path_factory.mktemp("limited"), text).running() as s:
        yield s


def test_no_client_passes_a_ceiling_or_a_floor_of_the_configuration(limited: Service) -> None:
    with limited.attach() as client:
        # GIVEN the holder of the pose, and limits in the configuration
        client.ee_pos(POSE)  # not even the pose's holder
        # WHEN it asks for more or less than they allow, THEN it is refused and nothing has changed
        for values in ({"max_demand": 0.061}, {"max_speed": 4.01}, {"offset": 0.079}, {"offset": "121 mm"}):
            before = client.params()
            with pytest.raises(RefusedError, match=r"\[limits\]") as refused:
                client.set_params(**values)
            assert refused.value.code == lb.ERR_BEYOND_LIMITS
            assert next(iter(values)) in str(refused.value), "it names the parameter"
            assert client.params() == before
        for offset in (0.0799, 0.1201):
            with pytest.raises(RefusedError, match=r"\[limits\].*offset"):
                client.sf_reset(offset)
        # WHEN it asks for the limits themselves, THEN it gets them
        client.set_params(max_demand="60 mm", max_speed=4.0)
        client.sf_reset(0.12)
        client.sf_reset(0.1)


def test_all_or_none_holds_across_a_limit(limited: Service) -> None:
    with limited.attach() as client:
        before = client.params()
        with pytest.raises(RefusedError):
            client.set_params(interval_size="3 mm", max_demand=0.5)
        assert client.params() == before


def test_who_does_not_hold_the_pose_changes_nothing_while_another_drives(limited: Service) -> None:
    with limited.attach() as driver, limited.attach() as other:
        # GIVEN a client that drives
        driver.ee_pos(POSE)
        before = driver.params()
        # WHEN another one changes parameters, THEN it is refused
        for ask in (lambda: other.set_params(max_demand=0.01), lambda: other.sf_reset(0.11)):
            with pytest.raises(RefusedError, match=f"pid {os.getpid()}") as refused:
                ask()
            assert refused.value.code == lb.ERR_NOT_POSE_HOLDER
        assert driver.params() == before
        # THEN the driver may change them
        driver.set_params(max_demand=0.02)
        # WHEN no client drives, THEN the other one may
        driver.release_pose()
        other.set_params(max_demand=0.03)  # no robot is driven now


@needs_root
def test_another_user_without_the_pose_changes_nothing_and_is_in_the_audit_trail(limited: Service) -> None:
    with limited.attach() as driver:
        # GIVEN a client that drives
        driver.ee_pos(POSE)
        before = driver.params()
        # WHEN another user's client changes parameters
        with program(OTHER_CLIENT, limited.name, before=AS_NOBODY) as other_client:
            pid = int(said(other_client))
            answers = [said(other_client) for _ in range(4)]
            # THEN it is refused
            assert all(a.startswith(f"{lb.ERR_NOT_POSE_HOLDER} ") for a in answers), answers
            assert driver.params() == before

            def entries() -> list[dict[str, object]]:
                return [e for e in driver.audit() if e["pid"] == pid]

            until(lambda: len(entries()) >= 4, "four entries")
        # THEN the audit trail tells of every attempt
        for e, parameter in zip(entries(), ("max_demand_m", "max_speed_mps", "pose_timeout_ns", "offset_m")):
            assert (e["uid"], e["parameter"], e["accepted"]) == (NOBODY, parameter, False)
            assert e["client"] == "other_client?[2J", "nothing that steers a terminal"
            assert e["result"] == "not_pose_holder"


def test_the_audit_trail_says_who_set_what_from_what_to_what(limited: Service) -> None:
    with limited.attach(label="the driver") as client:
        # GIVEN a client that has set parameters twice
        client.ee_pos(POSE)
        client.set_params(max_demand=0.021, interval_size="2 mm")
        client.set_params(max_demand=0.022, interval_size="3 mm")
        # THEN the trail has who, what, from what and to what
        mine = until(
            lambda: [e for e in client.audit() if e["client"] == "the driver" and e["new"] == 0.022], "it"
        )
        (e,) = mine
        assert (e["parameter"], e["old"], e["new"]) == ("max_demand_m", 0.021, 0.022)
        assert (e["pid"], e["uid"], e["accepted"], e["result"]) == (os.getpid(), os.geteuid(), True, "ok")
        assert 0.0 <= e["age_s"] < 60.0
        # THEN the command line shows the same
        shown = limited.run("status", "--audit").stdout
        assert (
            f"pid {os.getpid()} uid {os.geteuid()} the driver: set_params max_demand_m 0.021 -> 0.022: ok"
            in shown
        )
        reported = json.loads(limited.run("status", "--audit", "--json").stdout)
        assert e | {"age_s": 0} in [t | {"age_s": 0} for t in reported["audit"]]


def test_a_flood_of_refusals_is_gathered_and_leaves_what_was_accepted(limited: Service) -> None:
    with limited.attach(label="accepted") as driver, limited.attach(label="flood") as other:
        # GIVEN a change that was accepted
        driver.ee_pos(POSE)
        driver.set_params(max_demand=0.0123)
        # WHEN another client has more changes refused than the trail holds
        for _ in range(lb.AUDIT_ENTRIES + 100):
            ticket = other.set_params(max_demand=0.5, wait=False)
            with pytest.raises(RefusedError):
                ticket.result()
        # THEN these are gathered, and the accepted one is still there
        entries = until(
            lambda: (
                [e for e in driver.audit() if e["client"] == "flood" and e["count"] > 1] and driver.audit()
            ),
            "a gathered entry",
        )
        assert any(e["new"] == 0.0123 for e in entries), "the ring was not flooded"
        assert sum(e["client"] == "flood" for e in entries) < 20


def test_the_log_keeps_the_audit_trail(make_service: Make, tmp_path: Path) -> None:
    s, log = make_service(), tmp_path / "log"
    s.start_logged(log)
    with s.attach(label="logged") as client:
        client.set_params(max_demand=0.0456)
        until(lambda: "0.0456" in log.read_text(), "a line of the log")
    line = next(text for text in log.read_text().splitlines() if "0.0456" in text)
    assert f"audit: pid {os.getpid()} uid {os.geteuid()} logged: set_params max_demand_m" in line


def may(change: Callable[[], object]) -> bool:
    """Whether a change is accepted of a client that need not hold the pose."""
    try:
        change()
    except RefusedError as e:
        if e.code == lb.ERR_NOT_POSE_HOLDER:
            return False
        raise
    return True


@pytest.mark.parametrize(
    ("policy", "without", "as_other"),
    [("any", True, True), ("holder", True, False), ("holder-only", False, False)],
)
def test_the_configuration_says_who_may_set_parameters(
    make_service: Make, policy: str, without: bool, as_other: bool
) -> None:
    s = make_service(access=f'parameters = "{policy}"').start()

    def changes(client: Client) -> bool:
        return may(lambda: client.set_params(interval_size="3 mm"))

    with s.attach() as driver, s.attach() as other:
        assert changes(driver) is without
        driver.claim_pose()
        assert changes(driver)
        assert changes(other) is as_other


@pytest.mark.parametrize(
    ("policy", "without", "as_other"),
    [("any", True, True), ("holder", True, False), ("holder-only", False, False)],
)
def test_the_configuration_says_who_may_change_the_map(
    make_service: Make, policy: str, without: bool, as_other: bool, tmp_path: Path
) -> None:
    s = make_service(access=f'map = "{policy}"').start()
    region = (0.0, 0.0, 0.1, 0.1)
    kept = tmp_path / "kept.txt"
    HeightMap.over(region, grids=100).save(kept)

    with s.attach() as driver, s.attach() as other:

        def changes(client: Client) -> list[Callable[[], object]]:
            return [
                lambda: client.map_reset(region),
                lambda: client.map_refocus(region),
                lambda: client.map_install(kept),
            ]

        assert [may(c) for c in changes(other)] == [without] * 3
        driver.claim_pose()
        assert [may(c) for c in changes(driver)] == [True] * 3
        assert [may(c) for c in changes(other)] == [as_other] * 3


PUSHER = """
import sys, time
from surffollow.client import attach
from surffollow.errors import SurffollowError
with attach(sys.argv[1], owner=0) as client:
    try:
        client.push_range(0, time.monotonic_ns(), 0.08)
        print("pushed", flush=True)
    except SurffollowError as e:
        print(getattr(e, "code", -1), e, flush=True)
"""


@needs_root
@pytest.mark.parametrize(
    ("key", "may"), [("", False), ("nobody", True), ("65534", True), ("daemon", False), ("any", True)]
)
def test_the_configuration_says_whose_clients_may_push_ranges(
    make_service: Make, key: str, may: bool
) -> None:
    access = f'board_mode = "0644"\nsocket_mode = "0666"\nranges = "{key}"'
    driver = 'range_min_m = "50 mm"\nrange_max_m = "300 mm"'
    s = make_service(kind="external", driver=driver, access=access).start()
    with program(PUSHER, s.name, before=AS_NOBODY) as pusher:
        answer = said(pusher)
    assert answer == "pushed" if may else answer.startswith(f"{lb.ERR_NOT_ALLOWED} "), answer

    def free_again() -> bool:
        try:
            own.push_range(0, time.monotonic_ns(), 0.1)
        except BusyError:  # the client that pushed before has just ended
            return False
        return True

    with s.attach() as own:
        until(free_again, "the service's own user always may")


@pytest.mark.parametrize(
    ("table", "match"),
    [
        (
            {"limits": {"max_demand": {"max": "10 mm"}}, "follow": {"max_demand": "20 mm"}},
            "max_demand_m is 0.02",
        ),
        ({"limits": {"nonsense": {"max": 1}}}, "unknown parameter"),
        ({"limits": {"max_demand": {"most": 1}}}, "limits.max_demand"),
        ({"limits": {"max_demand": {}}}, "limits.max_demand"),
        ({"limits": {"max_demand": {"max": "1 s"}}}, "max_demand"),
        ({"limits": {"max_demand": {"max": 2e3}}}, "max_demand"),
        ({"limits": {"max_demand": {"min": 0.2, "max": 0.1}}}, "above max"),
        ({"limits": {"max_demand": {"max": 1}, "max_demand_m": {"max": 1}}}, "twice"),
        ({"access": {"parameters": "everybody"}}, "access.parameters"),
        ({"access": {"map": "everybody"}}, "access.map"),
        ({"access": {"ranges": "no-such-user"}}, "access.ranges.*no user 'no-such-user'"),
        ({"stop": {"on": ["thunder"]}}, "stop.on names 'thunder'"),
        ({"stop": {"on": ["request"]}}, "stop.on"),
        ({"watchdog": "4 ms"}, "watchdog"),
        ({"watchdog": "20 ms", "period": "10 ms"}, "less than 5 periods"),
    ],
)
def test_a_configuration_that_contradicts_itself_is_refused_by_name(table: dict, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        parse_config(table)


@pytest.mark.parametrize(
    ("follow", "limits", "match"),
    [
        ('offset = "110 mm"', 'max_demand = { max = "50 mm" }', "max_demand_m is 0.1"),
        ('plant_tau = "35 ms"', 'max_speed = { max = "4 m/s" }', "max_speed_mps is 8"),
        ('plant_tau = "80 ms"', 'loss_timeout = { max = "3 s" }', r"loss_timeout_ns is 5e\+09"),
        ("", 'max_demand = { max = "10 mm" }', "max_demand_m is 0.05"),
    ],
)
def test_a_start_ends_where_what_would_be_in_force_is_beyond_the_limits(
    make_service: Make, follow: str, limits: str, match: str
) -> None:
    s = make_service(follow=follow)
    s.config.write_text(s.config.read_text() + f"[limits]\n{limits}\n")
    with pytest.raises(AssertionError, match=match):
        s.start()
    assert objects_of(s.name) == set()


def test_what_the_driver_says_is_held_against_the_limits_too(make_service: Make) -> None:
    driver = 'range_min_m = "50 mm"\nrange_max_m = "400 mm"\nlatency_s = 0.5'
    s = make_service(kind="external", driver=driver)
    s.config.write_text(s.config.read_text() + '[limits]\nsensor_latency = { max = "30 ms" }\n')
    with pytest.raises(AssertionError, match=r"sensor_latency_ns is 5e\+08"):
        s.start()


def test_a_map_that_was_announced_before_somebody_drove_is_not_installed(make_service: Make) -> None:
    with make_service().start().attach() as member, member.__class__(member.name, stale_min_s=1.0) as driver:
        # GIVEN an installation that was announced while no client drove
        member.map_reset((0.0, 0.0, 0.1, 0.1))
        grid = (10, 10, 0.01, 0.0, 0.0, 0.0, 1e-4)
        values = (0.0, 0.0, 0.1, 0.1, *grid[2:])
        ticket = member._ask(lb.RQ_MAP_INSTALL, values, 5.0, False, (*grid[:2], 1))
        until(ticket.taken, "the announcement")
        # WHEN another client takes the pose
        driver.claim_pose()
        # THEN the installation is cancelled
        with pytest.raises(RefusedError) as refused:
            ticket.result(30.0)
        assert refused.value.code == lb.ERR_CANCELLED
        until(lambda: member.status()["map"]["busy"] == 0, "the end of the installation")


def test_what_a_client_wrote_steers_no_terminal() -> None:
    assert printable("a\x1b]0;x\x07\nb\u202e") == "a?]0;x??b?"
    entry = {
        **{"pid": 1, "uid": -1, "client": "", "request": "stop", "parameter": None, "old": None, "new": None},
        **{"result": "ok", "count": 3, "causes": ["request"], "reason": 'say "no"'},
    }
    assert audit_line(entry) == 'audit: pid 1 uid unknown -: stop (request) "say \\"no\\"": ok (3 times)'
