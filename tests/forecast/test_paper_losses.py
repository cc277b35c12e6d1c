"""Paper mode and lost readings: no mean, no speed and no ΔH spans a loss (docs/decisions/0002)."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import surffollow
from forecast.driving import MS, Kernel, default_params, names_of

T = 10_000 * MS
LEVEL = (0.0, 0.0, 0.0, 1.0)
SLOPE, SPEED = -0.1, 0.1
TOOLS = Path(__file__).parents[2] / "tools"


def kernel(**changes):
    plain = {"sensor_readings": 1, "permitted_variance_m": 0.0}
    return Kernel(default_params(**(plain | changes)))


def at(ms, z=None):
    """The pose over the ramp after so many milliseconds, at the stand-off or at a height."""
    x = SPEED * ms * 1e-3
    return (x, 0.0, 0.1 + SLOPE * x if z is None else z, *LEVEL)


def lost_between(ms):
    """The issue's losses: 0.5 s, two readings, and another loss."""
    return 1000 <= ms < 1500 or ms >= 1502


@pytest.mark.parametrize("lost_as", ["nan", "out of the window", "no conversions", "invalid conversions"])
def test_after_intermittent_losses_the_tool_is_not_driven_into_the_surface(lost_as):
    ready_made = lost_as in ("nan", "out of the window")
    k = kernel(sensor_readings=1 if ready_made else 7)
    counts = round((0.1 - 0.0508) / (0.1016 / 4095))
    for ms in range(2000):
        t_ns, lost = T + ms * MS, lost_between(ms)
        conversions = [(-MS + 80_000 * (n + 1), 0, int(lost), counts) for n in range(12)]
        if ready_made:
            reading = 0.1 if not lost else math.nan if lost_as == "nan" else 0.4
            o = k.step(t_ns, [(t_ns, at(ms))], ranges=[reading], given_t_ns=t_ns)
        else:
            o = k.step(t_ns, [(t_ns, at(ms))], () if lost and lost_as == "no conversions" else conversions)
        assert o["speed_mps"] <= SPEED * 1.001, f"{ms} ms"
        assert abs(o["demand"][2]) < 2e-3, f"{ms} ms: the tool is exactly at its stand-off"
    assert "NO_SENSOR" in names_of(o["status"])


def test_the_follower_in_process_is_not_driven_into_the_surface_either():
    f = surffollow.Follower({"mode": "paper", "permitted_variance": "0 m"}, offset_m=0.1)
    for ms in range(2000):
        f.pose(T + ms * MS, at(ms))
        assert abs(f.step(T + ms * MS, [math.nan if lost_between(ms) else 0.1])[2]) < 2e-3
        assert f.state()["speed_mps"] <= SPEED * 1.001


def test_the_first_reading_after_a_loss_counts_at_once():
    k = kernel()
    for ms in range(1501):
        t_ns, z = T + ms * MS, 0.12
        reading = math.nan if 1000 <= ms < 1500 else z - SLOPE * SPEED * ms * 1e-3
        o = k.step(t_ns, [(t_ns, at(ms, z))], ranges=[reading], given_t_ns=t_ns)
    assert (o["error_m"], o["delta_h_m"]) == (0.1 - reading, 0.0)


@pytest.mark.parametrize("gap", ["readings", "poses"])
def test_no_target_point_lies_between_the_places_before_and_after_a_loss(gap):
    k = kernel(ee_readings=16, pose_timeout_ns=50 * MS)
    targets = []
    for ms in range(1600):
        t_ns, lost = T + ms * MS, 1000 <= ms < 1500
        poses = [] if lost and gap == "poses" else [(t_ns, at(ms))]
        reading = math.nan if lost and gap == "readings" else 0.1
        o = k.step(t_ns, poses, ranges=[reading], given_t_ns=t_ns)
        if o["fresh"] & 1:
            targets.append(float(o["target_m"][0]))
        assert o["speed_mps"] <= SPEED * 1.001
    before, after = [x for x in targets if x < 0.125], [x for x in targets if x >= 0.125]
    assert max(before) <= 0.0999 + 1e-12
    assert min(after) >= 0.15 - 1e-12


def test_a_swift_tool_leaves_no_points_where_nothing_was_measured():
    k = kernel(ee_readings=8, interval_size_m=0.001)
    for n in range(100):
        t_ns, x = T + n * MS, 0.05 * (n // 5)  # a pose every 5 ms, 50 mm on
        o = k.step(t_ns, [(t_ns, (x, 0.0, 0.1, *LEVEL))], ranges=[0.1], given_t_ns=t_ns)
        assert abs(o["target_m"][0] / 0.05 - round(o["target_m"][0] / 0.05)) <= 0.001 / 0.05


@pytest.mark.parametrize("every_ms", [1, 4, 50])
def test_a_sensor_slower_than_the_steps_is_no_sensor_that_loses_readings(every_ms):
    k = kernel(ee_readings=4)
    for ms in range(3000):
        t_ns = T + ms * MS
        reading = 0.1 if ms % every_ms == 0 else math.nan
        o = k.step(t_ns, [(t_ns, at(ms))], ranges=[reading], given_t_ns=t_ns)
    assert o["speed_mps"] == pytest.approx(SPEED, rel=1e-6)
    assert k.state[0]["sense"]["losses"][0] <= 1
    assert k.state[0]["paper"]["point_count"][0] > 2000 / every_ms - 3


def test_slow_steps_with_a_reading_each_are_no_losses():
    k = kernel()
    for n in range(100):
        t_ns = T + 30 * n * MS
        k.step(t_ns, [(t_ns, at(30 * n))], ranges=[0.1], given_t_ns=t_ns)
    assert k.state[0]["sense"]["losses"][0] == 0
    assert k.output[0]["speed_mps"] == pytest.approx(SPEED, rel=1e-6)


def test_after_the_loss_timeout_a_reading_counts_as_the_first():
    k = kernel(loss_timeout_ns=200 * MS, pose_timeout_ns=1000 * MS)
    for ms, reading in ((0, 0.1), (1, 0.1), (300, 0.104)):  # no step between: no loss was seen
        o = k.step(
            T + ms * MS, [(T + ms * MS, (0, 0, 0.2, *LEVEL))], ranges=[reading], given_t_ns=T + ms * MS
        )
    assert o["error_m"] == 0.1 - 0.104


def test_random_runs_with_losses_stay_within_the_true_error_and_what_the_slope_explains(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    bench = __import__("bench_paper")
    got = bench.measure(400, 7)
    print(got)
    assert got["losses"] > 4000
    assert got["turns"] > 3000
    assert got["excess_m"] <= bench.ALLOWED_M
    assert got["beyond_ramp_m"] <= 2 * bench.ALLOWED_M
    assert got["ghost"] <= 1.0 + 1e-9
    assert got["speed"] <= 1.0 + bench.SPEED_ROUNDING


@pytest.mark.parametrize("slope", [-0.2, -0.1, 0.1, 0.2])
@pytest.mark.parametrize("then_mps", [0.0, 0.02, -0.1])
def test_in_a_loss_the_slope_explains_no_more_way_than_the_poses_tell(slope, then_mps):
    """A tool over a ramp that stops, slows down or turns back when the readings end."""
    f = surffollow.Follower({"mode": "paper", "permitted_variance": "0 m"}, offset_m=0.1)
    x, moved = 0.0, 0
    for ms in range(5000):
        lost = ms >= 3000
        x += (then_mps if lost else SPEED) * 1e-3
        f.pose(T + ms * MS, (x, 0.0, 0.1 + slope * x, *LEVEL))  # the stand-off is exact
        demand = f.step(T + ms * MS, [math.nan if lost else 0.1])[2]
        assert abs(demand) < 2e-3, f"{ms - 3000} ms after the loss"
        moved += lost and demand != 0.0
    assert moved > 500
