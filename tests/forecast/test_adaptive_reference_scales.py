"""The default follower behind its reference scales: no length or time of its own."""

import math

import numpy as np
import pytest

from forecast.driving import Kernel, default_params
from surffollow import Follower
from surffollow.config.params import PARAMS
from surffollow.forecast.reference_scales import exponents, scaled_defaults
from surffollow.shm.layout_follow import MODE_ADAPTIVE, TOO_CLOSE, VALID, Output

TICK_NS, READING_NS = 1 << 23, 1 << 22  # 8.4 and 4.2 ms: divisible by every factor tried
LENGTHS = [2.0**k for k in range(-8, 9)]
TIMES = range(-4, 9)
ONE = [(0.0, 0.0)]
LEADING = [(0.0, 0.0), (0.05, 0.0)]
RING = [(0.0, 0.0), (0.03, 0.0), (-0.015, 0.026), (-0.015, -0.026)]


def stretched(t_ns, power):
    return t_ns << power if power >= 0 else t_ns >> -power


def make_follower(length, second, places, **settings):
    return Follower(
        {
            **settings,
            "plant": {
                "tau_s": 0.04 * second,
                "v_max_mps": 0.2 * length / second,
                "a_max_mps2": 2.0 * length / second**2,
            },
            "sensors": [
                {
                    "position_m": [x * length, y * length, 0.0],
                    "near_m": 0.05 * length,
                    "far_m": 0.15 * length,
                }
                for x, y in places
            ],
        },
        offset_m=0.1 * length,
    )


def closed_loop(length, power, places=ONE, cycles=700, follower=None, every=1, gaps=()):
    """Demands there and back over wavy, stepped ground with noise, glitches and a loss."""
    follower = follower or make_follower(length, 2.0**power, places)
    rng = np.random.default_rng(5)
    z, x, demands = 0.1, 0.0, []
    for k in range(cycles):
        x += 0.15e-9 * READING_NS * (1.0 if k < 0.6 * cycles else -1.0)
        if k % 2 == 0:
            pose = (x * length, 0.0, (z + 2e-5 * rng.standard_normal()) * length, 0.0, 0.0, 0.0, 1.0)
            follower.pose(stretched(k * READING_NS, power), pose)
        readings = []
        for place, _ in places:
            at = x + place
            ground = 0.004 * math.sin(20.0 * at) + (0.006 if 0.15 < at < 0.22 else 0.0)
            noise = 2.5e-4 * rng.standard_normal() + (0.02 if rng.random() < 0.02 else 0.0)
            seen = k % every == 0 and not 300 < k < 340 and k not in gaps
            readings.append((z - ground + noise) * length if seen else math.nan)
        demand = follower.step(stretched(k * READING_NS, power), readings)
        demand[:3] /= length
        demands.append(demand)
        if k % 2 == 0:
            z += 0.2 * demand[2]
    return np.array(demands)


@pytest.fixture(scope="module")
def reference():
    found = {len(p): closed_loop(1.0, 0, p) for p in (ONE, LEADING, RING)}
    assert all(np.abs(d[:, 2]).max() > 1e-3 and np.isfinite(d).all() for d in found.values())
    assert np.abs(found[4][:, 3:]).max() > 1e-3, "four sensors turn the tool"
    return found


@pytest.mark.parametrize("length", LENGTHS)
def test_the_demand_scales_bit_for_bit_with_all_lengths(reference, length):
    assert (closed_loop(length, 0) == reference[1]).all()


@pytest.mark.parametrize("power", TIMES)
def test_the_demand_does_not_change_by_a_bit_with_all_times(reference, power):
    assert (closed_loop(1.0, power) == reference[1]).all()


@pytest.mark.parametrize("places", [LEADING, RING])
@pytest.mark.parametrize(("length", "power"), [(64.0, 5), (2.0**-5, -2), (2.0**-5, 3)])
def test_several_sensors_scale_likewise(reference, places, length, power):
    assert (closed_loop(length, power, places) == reference[len(places)]).all()


def test_means_of_several_readings_are_emptied_by_gaps_of_the_same_scale():
    """Gaps of 2 to 6 sample intervals, 8 to 25 ms, on both sides of the least that counts."""
    gaps = {first + n for first in range(50, 600, 20) for n in range(1 + first // 20 % 5)}
    runs = {
        power: closed_loop(
            1.0, power, gaps=gaps, follower=make_follower(1.0, 2.0**power, ONE, sensor_readings=3)
        )
        for power in (-4, 0, 3, 8)
    }
    assert all((demands == runs[0]).all() for demands in runs.values())


def clocks_loop(power):
    """Demands and status with late readings, a pose from the future, and clocks that are set back."""
    settings = {"pose_timeout_ns": stretched(12 << 23, power)}
    follower, found = make_follower(1.0, 2.0**power, ONE, **settings), []
    rng = np.random.default_rng(3)
    for k in range(2100):
        t = (k - (400 if k >= 1000 else 0)) * READING_NS
        late = 130 if 300 <= k < 500 else 500 if k >= 1800 else 0
        if k % 2 == 0:
            ahead = 350 * READING_NS if k in (600, 800) else 0
            pose = (0.1e-9 * k * READING_NS, 0.0, 0.1 + 2e-5 * rng.standard_normal(), 0.0, 0.0, 0.0, 1.0)
            follower.pose(stretched(t + ahead, power), pose)
        reading = 0.095 + 0.002 * math.sin(0.05 * k) + 2e-4 * rng.standard_normal()
        follower.step(stretched(t - late * READING_NS, power), [reading])
        demand = follower.step(stretched(t, power), [math.nan])
        found.append([demand[2], float(follower._output["status"][0])])
    return np.array(found)


@pytest.mark.parametrize("power", TIMES)
def test_what_counts_as_another_clock_scales_likewise(power):
    usual = clocks_loop(0)
    valid = usual[:, 1].astype(int) & VALID != 0
    assert valid[[290, 590, 990, 1499, 2099]].all()
    assert not valid[600]
    assert not valid[1000]
    assert (clocks_loop(power) == usual).all()


def test_remembered_ground_scales_likewise():
    """The way back is over ground of the first pass, written more than a second before."""
    runs = [closed_loop(length, power, cycles=1500) for length, power in ((1.0, 0), (32.0, 4))]
    assert (runs[0] == runs[1]).all()
    follower = make_follower(32.0, 16.0, ONE)
    closed_loop(32.0, 4, cycles=1500, follower=follower)
    assert follower._inputs["n_preview"][0] > 0, "remembered ground was looked up to the end"


def approach(length):
    """Demands and status of a follower whose range falls from the stand-off to the near limit."""
    follower, found = make_follower(length, 1.0, ONE), []
    for k in range(400):
        z = 0.1 - 1.3e-4 * max(0, k - 20)
        follower.pose(k * READING_NS, (0.0, 0.0, z * length, 0.0, 0.0, 0.0, 1.0))
        demand = follower.step(k * READING_NS, [z * length if z > 0.05 else math.nan])
        found.append([demand[2] / length, float(follower._output["status"][0])])
    return np.array(found)


@pytest.mark.parametrize("length", LENGTHS)
def test_the_thresholds_of_too_close_scale_with_window_and_stand_off(length):
    usual = approach(1.0)
    assert sum(int(s) & TOO_CLOSE != 0 for s in usual[:, 1]) > 20
    assert (approach(length) == usual).all()


def conversions_loop(length, power, cycles=400):
    """Outputs of the service's cycle with packed conversions and the parameters of its configuration."""
    second = 2.0**power
    p = default_params(
        mode=MODE_ADAPTIVE,
        n_channels=2,
        offset_m=0.1 * length,
        range_min_m=0.0508 * length,
        range_max_m=0.1524 * length,
        sensor_latency_ns=stretched(1 << 24, power),
        too_close_m=0.0546 * length,
        too_close_exit_m=0.0584 * length,
        plant_tau_s=0.04 * second,
        **(
            scaled_defaults(0.1 * length, 0.04 * second)
            | {
                "plant_v_max_mps": 0.2 * length / second,
                "plant_a_max_mps2": 2.0 * length / second**2,
            }
        ),
    )
    p["scale_m"] *= length
    p["zero_m"] *= length
    kernel, outputs = Kernel(p), []
    rng, z = np.random.default_rng(8), 0.13
    for k in range(cycles):
        t = stretched((k << 20) + (1 << 36), power)  # a stamp of 0 or less means never
        x = 0.1e-9 * (k << 20)
        ground = 0.004 * math.sin(40.0 * x) + (0.1 - 0.0505 if 300 < k < 320 else 0.0)
        words = []
        for j in range(6):
            counts = int((z - ground + 2e-4 * rng.standard_normal() - 0.0508) / 0.1016 * 4095)
            words.append((stretched((j - 6) << 17, power), j % 2, 0, max(counts, 0)))
        poses = [(t, (x * length, 0.0, z * length, 0.0, 0.0, 0.0, 1.0))] if k % 8 == 0 else ()
        o = kernel.step(t, poses, words)
        outputs.append(o.copy())
        if k % 8 == 7 and o["status"] & VALID:
            z += 0.2 * o["demand"][2] / length
    return outputs


@pytest.mark.parametrize(("length", "power"), [(16.0, 3), (2.0**-4, -3)])
def test_every_published_quantity_scales_as_its_unit_says(length, power):
    usual, scaled = conversions_loop(1.0, 0), conversions_loop(length, power)
    assert any(o["status"] & VALID for o in usual)
    for f in Output.FIELDS:
        a = np.array([o[f.name] for o in usual])
        b = np.array([o[f.name] for o in scaled])
        if f.unit == "ns":
            a = np.array([[stretched(int(v), power) for v in np.ravel(row)] for row in a]).reshape(a.shape)
        elif f.code == "f8":
            powers = (1, 0) if f.unit in ("m, rad", "m, 1") else exponents(f.unit)
            a = a * length ** powers[0] * 2.0 ** (power * powers[1])
        if f.name == "demand":
            assert (a[:, 2] == b[:, 2]).all()
        else:
            assert np.array_equal(a, b, equal_nan=f.code == "f8"), f.name


@pytest.mark.parametrize(("offset", "tau"), [(0.1, 0.04), (0.1016, 0.04), (0.0762, 0.05)])
def test_the_usual_cell_is_followed_with_the_given_numbers(offset, tau):
    f = Follower({"plant": {"tau_s": tau}}, offset_m=offset)
    assert (f._state["scaled"]["length"][0], f._state["scaled"]["time"][0]) == (1.0, 1.0)
    assert scaled_defaults(offset, tau) == {n: PARAMS[n].default for n in scaled_defaults(offset, tau)}


@pytest.mark.parametrize("name", ["pose_timeout_ns", "loss_timeout_ns"])
def test_time_outs_do_not_shrink_with_the_axis(name):
    """GIVEN a quick axis under a slow sensor THEN its readings are no loss: 1 Hz was never VALID."""
    assert scaled_defaults(0.1, 0.005)[name] == PARAMS[name].default
    assert scaled_defaults(0.1, 0.4)[name] == 8 * PARAMS[name].default


@pytest.mark.parametrize(
    ("scale", "tau_s", "least_mps"), [(100.0, 0.5, 3.0), (50.0, 1.5, 0.4), (0.01, 0.008, 0.2)]
)
def test_limits_of_the_axis_that_are_not_told_grow_with_the_job(scale, tau_s, least_mps):
    """A drone that was told stand-off and τ only touched ground that rose by 2 m/s: 0.2 m/s was assumed."""
    sensor = {"near_m": 0.05 * scale, "far_m": 0.3 * scale}
    f = Follower({"plant": {"tau_s": tau_s}, "sensors": [sensor]}, offset_m=0.1 * scale)
    assert f._params["plant_v_max_mps"][0] >= least_mps
    assert f._params["plant_a_max_mps2"][0] >= PARAMS["plant_a_max_mps2"].default


def test_a_parameter_that_is_given_is_taken_as_it_is_at_every_scale():
    f = Follower({"sensors": [{"near_m": 0.2, "far_m": 12.0}], "max_demand": 0.3}, offset_m=3.0)
    assert f._params["max_demand_m"][0] == 0.3
    assert f._params["gate_m"][0] == 32 * PARAMS["gate_m"].default


def test_a_stand_off_of_another_scale_begins_anew_and_is_followed_as_by_a_fresh_follower():
    used = make_follower(4.0, 1.0, ONE)
    used.set_params(range_min_m=0.01, too_close_m=0.02, too_close_exit_m=0.03)
    closed_loop(1.0, 0, cycles=200, follower=used)
    used.reset(0.1)
    fresh = make_follower(4.0, 1.0, ONE)
    fresh.set_params(range_min_m=0.01, too_close_m=0.02, too_close_exit_m=0.03)
    fresh.reset(0.1)

    def later(follower):
        start, demands = 2000 * READING_NS, []  # later than poses before could tell a speed
        for k in range(200):
            t = start + k * READING_NS
            follower.pose(t, (1e-9 * 0.1 * k * READING_NS, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
            demands.append(follower.step(t, [0.1 + 0.01 * math.sin(0.1 * k)])[2])
        return np.array(demands)

    assert np.abs(later(used) - later(fresh)).max() < 1e-3


@pytest.mark.parametrize("every", [26, 48])
def test_samples_more_than_100_ms_apart_score_the_models(every):
    follower = make_follower(1.0, 1.0, ONE)
    closed_loop(1.0, 0, cycles=80 * every, follower=follower, every=every)
    assert follower._state["adaptive"]["weights"]["scored"][0] > 30
