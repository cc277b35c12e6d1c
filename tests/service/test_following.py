"""Demands of the real service: limits, stale poses, fold-back, loss, dry run and freeze."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from running_service import (
    POSE,
    STANDOFF_M,
    Service,
    World,
    config_text,
    drive,
    unique_name,
    until,
)
from surffollow.client import STALE, Client, Demand
from surffollow.client.demand import VALID
from surffollow.shm.layout_follow import (
    DRYRUN,
    FROZEN,
    LIMITED,
    NO_SENSOR,
    POSE_STALE,
    SENSOR_LOST,
    TOO_CLOSE,
)

MODES = ("paper", "adaptive")
ZERO = [0.0] * 6


def at_height(height_m: float) -> tuple[float, ...]:
    return (*POSE[:2], height_m, *POSE[3:])


@pytest.fixture(params=MODES)
def client(service: Service, request: pytest.FixtureRequest) -> Iterator[Client]:
    """A client of a service in each mode; everything is put back afterwards."""
    assert service.world is not None
    with service.attach() as c:
        before = c.params()
        c.set_params(mode=request.param)
        c.sf_reset(STANDOFF_M)
        drive(c, lambda: c.dev_vector().valid, what="a demand")
        yield c
        service.world.pose = POSE
        c.set_params(**{k: before[k] for k in ("mode", "run", "max_demand_m", "loss_timeout_ns")})
        c.sf_reset(STANDOFF_M)
        # the fold-back latch is safety: only a tool that moves off the surface opens it
        for k in range(40):
            if not c.dev_vector().status & TOO_CLOSE:
                break
            follow(service, c, 0.07 + 0.001 * k)


def follow(service: Service, client: Client, height_m: float) -> Demand:
    """Move the tool, truly and as reported, and stay until the sensor has seen it; a demand of then."""
    assert service.world is not None
    service.world.pose = pose = at_height(height_m)
    end = client.status()["cycles"] + 120

    def after() -> Demand | None:
        passed = client.status()["cycles"] > end
        demand = client.dev_vector()
        return demand if passed and not demand.status & (STALE | POSE_STALE | NO_SENSOR) else None

    return drive(client, after, pose, "120 cycles")  # type: ignore[no-any-return]


def distance_m(client: Client) -> float:
    """The distance, once there is one."""
    return until(lambda: (d := client.raw_distance()) > 0.0 and d, "a distance")  # type: ignore[no-any-return]


def test_over_level_ground_at_its_standoff_it_demands_next_to_nothing(client: Client) -> None:
    demand = drive(
        client,
        lambda: (d := client.dev_vector()).valid and abs(d[2]) < 2e-3 and d.age_ns < 20_000_000 and d,
        what="a fresh demand of next to nothing",
    )
    assert demand[:2] == (0.0, 0.0)
    assert demand.pose_t_ns > 0
    assert demand.age_ns >= 0
    assert distance_m(client) == pytest.approx(STANDOFF_M, abs=1e-3)
    assert math.isnan(client.raw_distance(3)), "a channel without a sensor"


def test_the_demand_goes_where_the_offset_says_and_never_beyond_its_limit(client: Client) -> None:
    client.set_params(max_demand="5 mm")
    for offset, sign in ((0.08, -1), (0.12, 1)):
        client.sf_reset(offset)

        def at_its_limit(sign: int = sign) -> bool:
            demand = client.dev_vector()
            assert abs(demand[2]) <= 5e-3
            return bool(demand[2] * sign > 4e-3 and demand.status & LIMITED)

        drive(client, at_its_limit, what="a demand that way, told as limited")


def test_without_poses_it_is_stale_and_zero_until_they_come_again(client: Client) -> None:
    # WHEN no poses come, THEN the demand is stale and zero, and the map takes nothing
    stale = until(lambda: (d := client.dev_vector()).status & POSE_STALE and d, "POSE_STALE")
    assert list(stale) == ZERO
    assert not stale.valid
    # what the map thread tells is some milliseconds old: wait until it applied all that was handed to it
    settled = until(lambda: (s := client.status())["map"]["applied"] == s["samples"] and s, "an empty queue")
    applied = settled["map"]["applied"]
    cycles = client.status()["cycles"]
    until(lambda: client.status()["cycles"] > cycles + 50)
    assert client.status()["map"]["applied"] == applied, "the map takes nothing from an unknown place"
    assert distance_m(client) == pytest.approx(STANDOFF_M, abs=1e-3), "the distance is still told"
    # WHEN they come again, THEN demands are valid
    drive(client, lambda: client.dev_vector().valid, what="a demand again")


def test_too_close_only_demands_away_leave_until_a_move_shows_the_true_branch(
    service: Service, client: Client
) -> None:
    # GIVEN the nearest stand-off that is accepted, just beyond the threshold of 54.61 mm
    client.sf_reset(0.0547)
    # WHEN the tool comes too close, THEN only demands away are valid, after a reset too
    demand = follow(service, client, 0.053)
    assert demand.status & TOO_CLOSE
    assert demand.valid
    assert demand[2] > 0.0
    client.sf_reset(0.0547)
    assert follow(service, client, 0.053).status & TOO_CLOSE, "a reset does not open the latch"
    # WHEN it moves away and above the stand-off, THEN demands still lead away until the latch opens
    demand = follow(service, client, 0.0565)
    assert demand.status & TOO_CLOSE
    assert demand[2] > 0.0
    for height in (0.059, 0.062, 0.065, 0.068):
        demand = follow(service, client, height)
    assert not demand.status & TOO_CLOSE


def test_a_lost_surface_is_reported_and_ends_in_no_demand(service: Service, client: Client) -> None:
    # GIVEN 50 ms that are permitted without a surface
    client.set_params(loss_timeout="50 ms")
    # WHEN the surface goes out of sight
    assert service.world is not None
    service.world.pose = high = at_height(0.5)
    lost = drive(client, lambda: (d := client.dev_vector()).status & SENSOR_LOST and d, high, "SENSOR_LOST")
    # THEN the loss is reported, and the demand is zero
    assert lost.status & NO_SENSOR
    assert list(lost) == ZERO
    assert math.isnan(client.raw_distance())
    # WHEN it is in sight again, THEN demands are valid
    service.world.pose = POSE
    drive(client, lambda: client.dev_vector().valid, what="a demand again")


@pytest.mark.parametrize(("run", "bit"), [("dryrun", DRYRUN), ("freeze", FROZEN)])
def test_dry_run_and_freeze_publish_no_demand_that_a_robot_could_heed(
    client: Client, run: str, bit: int
) -> None:
    # WHEN the follower is to show what it would do, or to stand still
    client.sf_reset(0.12)
    client.set_params(run=run)
    idle = drive(client, lambda: (d := client.dev_vector()).status & bit and d)
    # THEN no demand is valid, and a dry run shows what it would be
    assert list(idle) == ZERO
    assert not idle.valid
    output = client.output()
    assert output is not None
    if run == "dryrun":
        shown = drive(client, lambda: (o := client.output()) and o["demand"][2] > 1e-3 and o)
        assert not shown["status"] & VALID
    else:
        assert output["demand"] == ZERO
    # WHEN it goes on, THEN demands are valid
    client.set_params(run="normal")
    drive(client, lambda: (d := client.dev_vector()).valid and d[2] > 1e-3, what="a demand")


def test_a_simulated_sensor_works_under_the_longest_name(tmp_path: Path) -> None:
    s = Service(tmp_path, config_text(kind="simulated"), name=unique_name().ljust(48, "x"))
    s.world = world = World(s.name)
    try:
        s.start()
        with s.attach() as client:
            drive(client, lambda: client.dev_vector().valid, what="a valid demand")
            assert client.status()["faults"] == []
    finally:
        s.purge()
        world.close()
