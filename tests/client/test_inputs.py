"""Requests and posts of a client: bad input is refused, by the library and again by the service."""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from running_service import POSE, Service, drive, until
from surffollow.client import Client, attach, board, observe
from surffollow.client.follower_report import follower_report, numbered_faults
from surffollow.client.request_sender import RequestSender
from surffollow.config.params import PARAMS, param_name
from surffollow.errors import (
    ClosedError,
    ConfigError,
    InvalidNameError,
    LayoutMismatchError,
    MapFileError,
    NotRunningError,
    PoseError,
    RefusedError,
    RegionError,
    RequestTimeoutError,
    UsageError,
)
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_adaptive import HEALTH_NAMES
from surffollow.shm.layout_follow import Params

NAN, INF = math.nan, math.inf
REGION = (0.0, 0.0, 0.1, 0.1)


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[Client]:
    with service.attach() as c:
        yield c


def scaled(norm: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.1, 0.5 * norm, 0.5 * norm, 0.5 * norm, 0.5 * norm)


@pytest.mark.parametrize("channel", [9, -1, 1.0, None, "0"])
def test_a_channel_that_no_sensor_can_have_is_a_usage_error(client: Client, channel: object) -> None:
    with pytest.raises(UsageError, match=f"channel must be a whole number from 0 to 7, not {channel!r}"):
        client.raw_distance(channel)  # type: ignore[arg-type]


def test_a_file_name_with_a_null_character_is_a_map_file_error(client: Client) -> None:
    with pytest.raises(MapFileError, match="null character"):
        client.upload_map("ground\0.txt")


def test_an_array_of_seven_arrays_is_a_pose_error(client: Client) -> None:
    """Arrays of one number compare like numbers, and are none."""
    column = np.array([[0.05], [0.05], [0.1], [0.0], [0.0], [0.0], [1.0]])
    with pytest.raises(PoseError, match="seven numbers"):
        client.ee_pos(column)  # type: ignore[arg-type]


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_pose_that_is_not_finite_is_a_value_error(client: Client, place: int, value: float) -> None:
    pose = list(POSE)
    pose[place] = value
    with pytest.raises(PoseError, match="finite") as caught:
        client.ee_pos(pose)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("pose", [(), POSE[:6], (*POSE, 0.0), "0000001", 7, None, ("a",) * 7, ([],) * 7])
def test_a_pose_that_is_not_seven_numbers_is_refused(client: Client, pose: object) -> None:
    with pytest.raises(PoseError, match="seven numbers"):
        client.ee_pos(pose)  # type: ignore[arg-type]


@pytest.mark.parametrize("norm", [0.0, 0.9989, 1.0011, 2.0, -0.5, 1e200])
def test_a_quaternion_that_is_not_unit_is_refused(client: Client, norm: float) -> None:
    with pytest.raises(PoseError, match=r"norm|finite"):
        client.ee_pos(scaled(norm))


@pytest.mark.parametrize("norm", [0.9991, 1.0009, -1.0])
def test_a_quaternion_that_is_nearly_unit_is_normalised(client: Client, norm: float) -> None:
    before = client.status()
    client.ee_pos(scaled(norm))
    until(lambda: client.status()["poses"] > before["poses"], "a pose taken")
    assert client.status()["poses_refused"] == before["poses_refused"]


@pytest.mark.parametrize("x", [1e9, -1e12, 1e308])
def test_a_position_beyond_1e9_m_is_refused_and_one_within_is_not(client: Client, x: float) -> None:
    with pytest.raises(PoseError, match="within 1e\\+09 m"):
        client.ee_pos((x, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
    client.ee_pos((6.4e6, -3e7, 0.1, 0.0, 0.0, 0.0, 1.0))


def test_a_pose_from_the_future_or_too_old_is_refused_and_a_late_one_is_not(client: Client) -> None:
    now = time.monotonic_ns()
    with pytest.raises(PoseError, match="in the future"):
        client.ee_pos(POSE, now + 50_000_000)
    with pytest.raises(PoseError, match="ms old"):
        client.ee_pos(POSE, now - 150_000_000)

    def taken() -> bool:  # unless this process slept between the clock and the look at it
        with contextlib.suppress(PoseError):
            client.ee_pos(POSE, time.monotonic_ns() - 20_000_000)
            return True
        return False

    until(taken, "a late pose")


def test_a_client_learns_of_a_pose_timeout_that_another_one_set(service: Service, client: Client) -> None:
    try:
        with service.attach() as other:
            other.set_params(pose_timeout="20 ms")

        def refusal() -> str:
            try:
                client.ee_pos(POSE, time.monotonic_ns() - 50_000_000)
            except PoseError as e:
                return str(e)
            return ""

        until(lambda: "none older than 20 ms" in refusal(), "the refusal")
    finally:
        client.set_params(pose_timeout="100 ms")


@pytest.mark.parametrize(
    "region",
    [
        (0, 0, 0, 1),
        (0, 0, 1, 0),
        (1, 0, 0, 1),
        (0, 0, 1.1e6, 1),
        (NAN, 0, 1, 1),
        (0, 0, INF, 1),
        (0, 0, 1),
        (0, 0, 1, 1, 1),
        "abcd",
        None,
        (0, 0, 1, "x"),
        (-1e308, 0, 1e308, 1),
    ],
)
def test_a_region_that_is_none_is_refused_before_it_leaves(client: Client, region: object) -> None:
    before = client.status()["requests"]
    for ask in (client.map_reset, client.map_refocus):
        with pytest.raises(RegionError):
            ask(region)  # type: ignore[operator]
    assert client.status()["requests"] == before


@pytest.mark.parametrize(
    "region",
    [(0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0), (NAN,) * 4, (0.0, 0.0, 2e6, 1.0), (0.0, 0.0, INF, 1.0)],
)
@pytest.mark.parametrize("code", [lb.RQ_MAP_RESET, lb.RQ_MAP_REFOCUS])
def test_the_service_checks_a_region_itself(client: Client, code: int, region: tuple[float, ...]) -> None:
    with pytest.raises(RefusedError, match="region") as caught:
        client._request(code, values=region).result()
    assert caught.value.code == lb.ERR_BAD_REGION


def test_refocus_without_a_map_is_refused(make_service: Callable[..., Service]) -> None:
    s = make_service().start()
    with s.attach() as c:
        with pytest.raises(RefusedError, match="map_reset") as caught:
            c.map_refocus(REGION)
        assert caught.value.code == lb.ERR_NO_MAP
        c.map_reset(REGION)
        c.map_refocus((0.02, 0.02, 0.08, 0.08))


def test_parameters_are_set_all_or_none(client: Client) -> None:
    before = client.params()
    with pytest.raises(ConfigError, match="range_size"):
        client.set_params(interval_size="3 mm", range_size=0)
    assert client.params() == before
    # past the library: the service refuses the whole request for its second value
    numbers = [Params.offset(n) // 8 for n in ("interval_size_m", "range_size")]
    for bad in (0.0, 2.5, NAN, INF, 513.0):
        with pytest.raises(RefusedError, match="range_size"):
            client._request(lb.RQ_SET_PARAMS, numbers, [0.003, bad], 2).result()
    assert client.params() == before
    client.set_params(interval_size="3 mm", range_size=6)
    try:
        after = client.params()
        assert (after["interval_size_m"], after["range_size"]) == (0.003, 6)
    finally:
        client.set_params(interval_size=before["interval_size_m"], range_size=before["range_size"])


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"too_close_exit": 0.1524}, "too_close_exit_m"),
        ({"range_max": "110 mm", "too_close_exit": "120 mm"}, "too_close_exit_m"),
        ({"too_close": "60 mm"}, "too_close_m"),
        ({"range_min": "60 mm"}, "too_close_m"),
        ({"offset": "54 mm"}, "too_close_m"),
        ({"offset": "160 mm"}, "offset_m"),
    ],
)
def test_values_at_odds_with_the_window_are_refused_with_the_rule(
    client: Client, values: dict[str, object], name: str
) -> None:
    before = client.params()
    with pytest.raises(RefusedError, match=rf"\({name}\); range_min_m <= too_close_m <= ") as refused:
        client.set_params(**values)
    assert refused.value.code == lb.ERR_BAD_VALUE
    assert client.params() == before


def test_a_reset_to_a_stand_off_that_would_be_too_close_is_refused(client: Client) -> None:
    before = client.params()
    for offset in ("54 mm", "50 mm", "153 mm"):
        with pytest.raises(RefusedError, match=r"\(offset_m\)"):
            client.sf_reset(offset)  # type: ignore[arg-type]  # text is taken, too
    assert client.params() == before


def test_a_duration_without_a_unit_is_refused_before_it_is_sent(client: Client) -> None:
    with pytest.raises(ConfigError, match="loss_timeout = 2 has no unit; give one, for instance '2 s'"):
        client.set_params(loss_timeout=2)
    with pytest.raises(ConfigError, match="as offset and as offset_m"):
        client.set_params(offset=0.1, offset_m=0.1)


@pytest.mark.parametrize("n", [0, -1, 17, 2**62])
def test_a_request_with_an_impossible_count_of_arguments_is_refused(client: Client, n: int) -> None:
    with pytest.raises(RefusedError):
        client._request(lb.RQ_SET_PARAMS, [Params.offset("range_size") // 8], [5.0], n).result()


@pytest.mark.parametrize("number", [-1, 2**62, -(2**63), Params.offset("n_channels") // 8, Params.SIZE // 8])
def test_a_word_that_is_no_parameter_cannot_be_set(client: Client, number: int) -> None:
    with pytest.raises(RefusedError, match="out of bounds"):
        client._request(lb.RQ_SET_PARAMS, [number], [1.0], 1).result()


@pytest.mark.parametrize("code", [0, 99, -1, 2**62])
def test_a_request_that_the_service_does_not_know_is_refused(client: Client, code: int) -> None:
    with pytest.raises(RefusedError, match="does not know") as caught:
        client._request(code).result()
    assert caught.value.code == lb.ERR_UNKNOWN_REQUEST


def test_parameter_names_and_units_are_checked_with_a_hint(client: Client) -> None:
    with pytest.raises(ConfigError, match="did you mean interval_size_m"):
        client.set_params(intervall_size=1)
    with pytest.raises(ConfigError, match="offset"):
        client.set_params(offset="0.1 s")
    with pytest.raises(TypeError):
        client.set_params()
    with pytest.raises(ConfigError):
        client.sf_reset(NAN)
    with pytest.raises(RefusedError):
        client._request(lb.RQ_SF_RESET, values=[NAN]).result()


def test_a_ticket_does_not_wait_and_is_done_when_the_service_answered(client: Client) -> None:
    ticket = client.sf_reset(0.1, wait=False)
    until(ticket.done, "the answer")
    assert ticket.result(0.0) == 0
    refused = client._request(99)
    until(refused.done, "the answer")
    with pytest.raises(RefusedError):
        refused.result(0.0)


@pytest.mark.parametrize("call", ["taken", "done", "under_way", "result"])
def test_a_ticket_of_a_closed_client_says_that_it_was_closed(service: Service, call: str) -> None:
    # GIVEN a request whose answer was not read
    client = service.attach()
    ticket = client.sf_reset(0.1, wait=False)
    # WHEN the client is closed
    client.close()
    # THEN its ticket refuses every question
    with pytest.raises(ClosedError, match="was closed"):
        getattr(ticket, call)()


def test_requests_of_two_clients_are_answered_to_each(service: Service, client: Client) -> None:
    with service.attach() as other:
        tickets = []
        for _ in range(20):
            pair = (client._request(99), other.sf_reset(0.1, wait=False))
            until(lambda pair=pair: all(t.done() for t in pair), "both answers")
            tickets.append(pair)
        for bad, good in tickets:
            assert good.result(0.0) == 0
            with pytest.raises(RefusedError):
                bad.result(0.0)


def test_a_request_without_an_answer_times_out(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    with service.attach() as c:
        ticket = c.sf_reset(0.1)
        ticket._answer, ticket.counter = None, ticket.counter + 1000
        with pytest.raises(RequestTimeoutError, match=r"did not answer within 0\.05 s") as caught:
            ticket.result(0.05)
        assert isinstance(caught.value, TimeoutError)


def test_a_client_of_another_layout_is_refused_with_both_hashes(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board, "LAYOUT_HASH", 0x77B1)
    with pytest.raises(LayoutMismatchError, match=r"expects 00000000000077b1.*restart"):
        service.attach()
    with pytest.raises(LayoutMismatchError):
        service.observe()


@pytest.mark.parametrize(
    "name", ["", "a/b", "../surf", ".surf", "a b", "x" * 49, "surf.map", "surf.sock", "surf.lock", None, 7]
)
@pytest.mark.parametrize("look", [attach, observe])
def test_a_name_that_no_service_can_have_is_a_value_error(
    look: Callable[[str], object], name: object
) -> None:
    with pytest.raises(InvalidNameError, match=r"not allowed|cannot be called") as caught:
        look(name)  # type: ignore[arg-type]
    assert isinstance(caught.value, ValueError)


def test_a_label_that_is_no_text_is_refused() -> None:
    with pytest.raises(UsageError, match="label must be a text"):
        attach("surf", label=5)  # type: ignore[arg-type]


def test_a_stopped_service_refuses_requests_at_once(make_service: Callable[..., Service]) -> None:
    s = make_service().start()
    with s.attach() as c:
        s.terminate()
        until(lambda: not c.alive(), "silence")
        with pytest.raises(NotRunningError, match="does not answer"):
            c.sf_reset(0.1)
        with pytest.raises(NotRunningError):
            c.ee_pos(POSE)
        assert list(c.dev_vector()) == [0.0] * 6


def test_the_papers_spellings_are_the_same_functions(client: Client) -> None:
    pairs = ("EEPos", "ee_pos"), ("SFReset", "sf_reset"), ("MapReset", "map_reset")
    for paper, ours in (*pairs, ("MapRefocus", "map_refocus"), ("UpLoadMap", "upload_map")):
        assert getattr(Client, paper) is getattr(Client, ours)
    assert len(client.DevVector()) == 6
    drive(client, lambda: client.RawDistance() > 0, what="a distance")


def test_faults_are_numbered_and_what_is_unknown_is_null(client: Client) -> None:
    assert numbered_faults(0b10010, 0b100) == [
        {"number": 2, "name": "STUCK"},
        {"number": 5, "name": "CLOCK"},
        {"number": 35, "name": "SAMPLES_LOST"},
    ]
    assert follower_report(None, 1) == {"mode": "adaptive"}
    reported = client.status()["follower"]
    assert reported["mode"] == "adaptive"
    assert reported["health"] in HEALTH_NAMES
    assert reported["latency_s"] == pytest.approx(0.032, abs=5e-3)
    assert reported["range_size"] >= 1
    assert all(v is None or not isinstance(v, float) or math.isfinite(v) for v in reported.values())


def test_every_parameter_is_known_without_its_unit() -> None:
    short = {re.sub(r"_(ns|s|m|mps|rad|radps)\d?$", "", name): name for name in PARAMS}
    assert len(short) == len(PARAMS)
    for name, full in short.items():
        assert param_name(name) == full
    for name in ("plant_a_max", "max_jerk", "max_turn", "max_turn_accel", "plan_effort"):
        assert name in short


def test_a_closed_client_says_that_it_was_closed(service: Service) -> None:
    client, watcher = service.attach(), service.observe()
    client.sf_reset(0.1)
    watcher.map_changes()
    for attachment in (client, watcher):
        attachment.close()
        attachment.close()  # twice is as good as once
        for call in (
            attachment.dev_vector,
            attachment.alive,
            attachment.status,
            attachment.params,
            attachment.output,
            attachment.raw_distance,
            attachment.reattach,
            attachment.map_changes,
            lambda a=attachment: a.dev_vector_into(bytearray(88)),
            lambda a=attachment: a.map_height(0.0, 0.0),
        ):
            with pytest.raises(ClosedError, match="was closed"):
                call()
    for call in (
        lambda: client.ee_pos(POSE),
        lambda: client.sf_reset(0.1),
        lambda: client.map_reset(REGION),
        lambda: client.exclusive().__enter__(),
    ):
        with pytest.raises(ClosedError, match="was closed"):
            call()


@pytest.mark.parametrize("t_ns", [10**400, -(10**400)])
def test_a_time_that_no_clock_has_is_a_pose_error(client: Client, t_ns: int) -> None:
    with pytest.raises(PoseError, match=r"in the future; use CLOCK_MONOTONIC|old; the service takes none"):
        client.ee_pos(POSE, t_ns)


def test_a_region_whose_side_no_float_holds_is_a_region_error(client: Client) -> None:
    with pytest.raises(RegionError, match="a region is"):
        client.map_reset((0.0, 0.0, 10**400, 1.0))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"stale_min_s": NAN}, "stale_min_s must be 0 to"),
        ({"stale_min_s": INF}, "stale_min_s must be 0 to"),
        ({"stale_min_s": -1.0}, "stale_min_s must be 0 to"),
        ({"stale_min_s": "5 ms"}, "stale_min_s '5 ms': expected .* a time"),
        ({"stale_periods": NAN}, "expected a whole number of at least 1"),
        ({"stale_periods": 0}, "stale_periods must be a whole number of at least 1"),
        ({"stale_periods": 2.5}, "stale_periods must be a whole number"),
        ({"owner": 3.5}, "no user 3.5 on this machine; name the service's user"),
    ],
)
def test_settings_of_an_attachment_that_cannot_be_are_refused(
    service: Service, settings: dict, says: str
) -> None:
    for attaching in (attach, observe):
        with pytest.raises((UsageError, ConfigError), match=says):
            attaching(service.name, **settings)


def test_settings_of_an_attachment_may_be_numbers_of_numpy(service: Service) -> None:
    with observe(service.name, stale_periods=np.int64(5), stale_min_s=np.float32(0.01)) as observer:
        assert observer.output()["epoch"] == observer.epoch


def test_a_forked_child_that_has_no_slot_yet_is_not_told_of_a_restart_alone() -> None:
    waiting = object.__new__(RequestSender)
    waiting.name, waiting.ensure_slot = "surf", lambda: False  # type: ignore[method-assign]
    with pytest.raises(NotRunningError, match="or this process is a forked child"):
        waiting._has_slot(0.0)
