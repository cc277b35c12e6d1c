"""A service that runs and hands out no slots: a control loop's calls return at once, and go on alone."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable

import pytest

from hanging_socket import MANNERS, hanging
from running_service import PATIENT_S, POSE, Service, until
from surffollow.client import Client, slot
from surffollow.client.reclaim import CLAIM_ANSWER_S
from surffollow.errors import NotReadyError, NotRunningError, SurffollowError

TICKS = 300
MOST_S = 0.2  # half of what one waiting exchange took; a busy machine may cost a tick


def slow_calls(call: Callable[[], object], others: Callable[[], object]) -> int:
    """How many of `TICKS` ticks took longer than `MOST_S`; `call` must raise in each of them."""
    slow = 0
    for _ in range(TICKS):
        began = time.monotonic()
        with pytest.raises(NotRunningError):
            call()
        others()
        slow += time.monotonic() - began > MOST_S
    return slow


def held_again(client: Client) -> bool:
    with contextlib.suppress(SurffollowError):
        client.ee_pos(POSE)
        return client.slot >= 0 and client._pose_held
    return False


@pytest.mark.parametrize("manner", MANNERS)
def test_no_call_of_a_control_loop_waits_for_a_socket_that_hangs(
    make_service: Callable[..., Service], manner: str
) -> None:
    s = make_service().start()
    with s.attach(stale_min_s=PATIENT_S) as robot:
        robot.ee_pos(POSE)
        s.kill()
        s.start()
        with hanging(s.name, manner):
            until(lambda: robot.dev_vector() and robot.reattach(), "the new board")
            assert slow_calls(lambda: robot.ee_pos(POSE), robot.dev_vector) < TICKS // 10
            assert slow_calls(lambda: robot.sf_reset(0.1, wait=False), robot.alive) < TICKS // 10
            assert not robot.dev_vector().valid
        until(lambda: held_again(robot), "the pose")
        before = robot.status()["poses"]
        until(lambda: held_again(robot) and robot.status()["poses"] > before, "poses go on")


def test_attaching_to_a_socket_that_hangs_ends_in_its_time(
    make_service: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slot, "EXCHANGE_S", 0.2)
    monkeypatch.setattr(slot, "ATTACH_S", 0.5)
    s = make_service().start()
    with hanging(s.name, MANNERS[0]):
        began = time.monotonic()
        with pytest.raises(NotReadyError, match="slot"):
            s.attach()
        assert time.monotonic() - began < 5.0
    s.attach().close()


def test_pose_and_channels_of_ranges_are_claimed_anew_in_steps_whichever_call_comes_first(
    make_service: Callable[..., Service],
) -> None:
    driver = 'range_min_m = "50 mm"\nrange_max_m = "300 mm"\nchannels = 2'
    s = make_service(kind="external", driver=driver).start()
    with s.attach(stale_min_s=PATIENT_S) as robot:
        calls = [
            lambda: robot.ee_pos(POSE),
            lambda: robot.push_range(0, time.monotonic_ns(), 0.1),
            lambda: robot.push_range(1, time.monotonic_ns(), 0.1),
        ]
        for call in calls:
            call()
        s.kill()
        until(lambda: not robot.alive(), "silence")
        s.start()
        until(lambda: held_again(robot), "the pose, and with it a slot")
        s.freeze()  # the new claims are not answered, and the board is not stale yet
        try:
            for call in calls[1:]:
                began = time.monotonic()
                with pytest.raises(NotRunningError):
                    call()
                assert time.monotonic() - began < CLAIM_ANSWER_S
        finally:
            s.send(signal.SIGCONT)

        def all_go_on() -> bool:
            done = 0
            for call in calls:  # in turn, as a loop does
                with contextlib.suppress(NotRunningError):
                    call()
                    done += 1
            return done == len(calls)

        until(all_go_on, "pose and ranges")
