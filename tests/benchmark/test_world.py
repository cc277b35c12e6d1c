"""Properties of the simulated world that methods rely on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark import baselines as b
from surffollow.benchmark.conditions import STANDOFF_M, Conditions, PoseConfig, SensorConfig, load_conditions
from surffollow.benchmark.drive import drive, two_passes
from surffollow.benchmark.scene import START_NS, TRAINING_STREAM, Scene, make_scene
from surffollow.errors import ConfigError, UsageError
from surffollow.sim.profiles import SHAPES, Profile
from surffollow.sim.profiles_measured import from_points
from surffollow.sim.profiles_random import RANDOM

from .naive_world import PythonP, naive_run


def short(profile: Profile, length_m: float = 0.6) -> Profile:
    keep = profile.x_m <= profile.start_m + length_m + 0.2
    return from_points(profile.name, profile.x_m[keep][400:], profile.heights_m[keep][400:])


def scene_of(
    name: str, conditions: Conditions, speed_mps: float = 0.2, seed: int = 3, length_m: float = 0.6
) -> Scene:
    return make_scene(short((SHAPES | RANDOM)[name](seed), length_m), speed_mps, seed, conditions)


def run(scene: Scene, kind: int = b.P, params: tuple[float, ...] = (0.5,)):  # type: ignore[no-untyped-def]
    s, w = scene.fresh()
    b.run_jitted(kind, params, s, w)
    return s, w


@pytest.mark.parametrize(
    "conditions",
    [
        Conditions(),
        Conditions(lead_m=0.05, sensor=SensorConfig(latency_s=0.0)),
        Conditions(pose=PoseConfig(rate_hz=32.0, latency_s=0.017), sensor=SensorConfig(rate_hz=60.0)),
    ],
)
@pytest.mark.parametrize("surface", ["fy91", "ramp-20"])
def test_run_equals_the_slow_twin_of_the_world(surface: str, conditions: Conditions) -> None:
    scene = scene_of(surface, conditions, length_m=0.4)
    _, w = run(scene)
    assert np.allclose(w.z, naive_run(scene, conditions, 0.5), atol=1e-12)


def test_follower_of_another_module_meets_the_same_world_as_a_jitted_method() -> None:
    scene = scene_of("step", Conditions())
    s, w = scene.fresh()
    drive(PythonP(scene.conditions), s, w)
    _, jitted = run(scene)
    assert np.array_equal(w.z, jitted.z)
    assert np.array_equal(w.orders[: int(s["ticks"])], jitted.orders[: int(s["ticks"])])


def test_run_repeats_to_the_last_bit_and_leaves_its_scene_untouched() -> None:
    scene = scene_of("iso-c", Conditions())
    (_, one), (_, two) = run(scene), run(scene)
    assert np.array_equal(one.z, two.z)
    again = scene_of("iso-c", Conditions())
    assert np.array_equal(again.world.readings["noise"], scene.world.readings["noise"])


def test_everything_arrives_late_by_its_latency_and_carries_its_stamp() -> None:
    c = Conditions(sensor=SensorConfig(latency_s=0.03), pose=PoseConfig(latency_s=0.01))
    scene = scene_of("flat", c)
    follower = PythonP(c)
    s, w = scene.fresh()
    drive(follower, s, w)
    now = 0
    for kind, t_ns, value in follower.calls:
        ms = (t_ns - START_NS) // 1_000_000
        if kind == "pose":
            now = max(now, ms + 10)
            assert value == pytest.approx(0.2e-3 * ms, abs=1e-3)
        elif not math.isnan(value):
            now = max(now, ms + 30)
        else:
            assert ms >= now  # a tick's own time, after all that has arrived
            now = ms
    readings = [t for kind, t, v in follower.calls if kind == "step" and not math.isnan(v)]
    assert np.all(np.diff(readings) == 4_000_000)


def test_lost_readings_come_as_nan_and_glitches_as_rare_as_configured() -> None:
    c = Conditions()
    scene = make_scene(SHAPES["flat"](0), 0.1, 0, c, ((10.0, 12.0),))
    _, w = run(scene)
    lost = np.isnan(w.readings["range"])
    assert np.array_equal(lost, (w.readings["ms"] >= 10_000) & (w.readings["ms"] < 12_000))
    big = np.abs(w.readings["noise"][~lost]) > 1.5e-3
    assert np.mean(big) == pytest.approx(0.01 * (1 - 1.5 / 30), abs=0.003)
    assert np.std(w.readings["noise"][~lost][~big]) == pytest.approx(0.25e-3, rel=0.1)


def test_sensor_reads_only_inside_its_window_and_in_its_steps() -> None:
    scene = scene_of("fy91", Conditions(sensor=SensorConfig(bits=8)))
    _, w = run(scene, b.HOLD, (0.0,))
    r = w.readings["range"][np.isfinite(w.readings["range"])]
    step = (0.1524 - 0.0508) / 256
    assert np.allclose((r - 0.0508) / step, np.round((r - 0.0508) / step), atol=1e-6)
    assert r.min() >= 0.0508 - 1e-9
    assert r.max() <= 0.1524 + step


def test_demand_is_added_to_the_report_it_refers_to_or_to_the_newest_as_configured() -> None:
    for reference, behind in (("report", 1), ("newest", 0)):
        scene = scene_of("hump", Conditions(reference=reference))
        s, w = run(scene)
        ticks = np.arange(5, int(s["ticks"]))
        expected = w.reports["z"][ticks - behind] + w.orders["demand"][ticks]
        assert np.allclose(w.orders["setpoint"][ticks], expected, atol=1e-15)


def test_demand_that_is_no_number_holds_the_report_and_is_counted() -> None:
    class Broken(PythonP):
        def step(self, t_ns: int, ranges_m: object) -> list[float]:
            return [math.nan] * 6

    scene = scene_of("flat", Conditions())
    s, w = scene.fresh()
    drive(Broken(scene.conditions), s, w)
    assert int(s["bad_demands"]) == int(s["ticks"]) > 0
    assert np.isfinite(w.z).all()


def test_training_noise_is_never_test_noise() -> None:
    test = make_scene(SHAPES["flat"](0), 0.4, 5, Conditions())
    training = make_scene(SHAPES["flat"](0), 0.4, 5, Conditions(), stream=TRAINING_STREAM)
    assert not np.array_equal(test.world.readings["noise"], training.world.readings["noise"])


def test_second_pass_continues_in_time_over_the_same_ground() -> None:
    first, second = scene_of("hump", Conditions()), scene_of("hump", Conditions(), seed=3)
    follower = PythonP(first.conditions)
    (_, one), (_, two) = two_passes(follower, first, second)
    poses = [t for kind, t, _ in follower.calls if kind == "pose"]
    assert np.all(np.diff(poses) > 0)
    assert one.z[0] == two.z[0]


def test_conditions_are_read_from_a_file_and_nonsense_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "plant.toml"
    path.write_text("tau_s = 0.06\n[sensor]\nlatency = '100 ms'\n[pose]\nrate_hz = 32\n")
    c = load_conditions(path)
    assert (c.plant.tau_s, c.nominal_tau_s, c.sensor.latency_s, c.pose.rate_hz) == (0.06, 0.06, 0.1, 32.0)
    for text in (
        "[sensor]\nnoise = 1\n",
        "[sensor]\nglitch_rate = 2.0\n",
        "[pose]\nrate_hz = 0\n",
        "sensor = 0\n",
        "pose = [1]\n",
    ):
        path.write_text(text)
        with pytest.raises(ConfigError):
            load_conditions(path)
    for speed in (0.0, math.nan, -1.0, 100.0):
        with pytest.raises(UsageError, match="speed"):
            make_scene(SHAPES["flat"](0), speed, 0, Conditions())
    with pytest.raises(UsageError, match="long"):
        make_scene(from_points("dot", np.array([0.0, 0.1]), np.zeros(2)), 0.1, 0, Conditions())


def test_holding_still_keeps_the_first_height() -> None:
    scene = make_scene(SHAPES["hump"](0), 0.4, 0, Conditions())
    _, w = run(scene, b.HOLD, (0.0,))
    assert np.abs(w.z - scene.ground_m[0] - STANDOFF_M).max() < 0.3e-3
