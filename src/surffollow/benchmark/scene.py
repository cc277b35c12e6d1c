"""Make the world of a run from profile, speed, conditions and seed; the noise is drawn beforehand.

Every method meets the same noise: it is drawn per seed, before and apart from what a method does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.loop import MS_NS, ORDER, READING, REPORT, RUN, World
from surffollow.errors import UsageError
from surffollow.sim.profiles import Profile

START_NS = 1_000 * MS_NS  # simulated time does not begin at 0: 0 may not be taken for "never"
TEST_STREAM = 1
TRAINING_STREAM = 2  # tuning draws from another stream: no test seed can ever be a training seed


@dataclass(frozen=True)
class Scene:
    """One surface, speed and seed under some conditions: what all methods are run in.

    Attributes
    ----------
    world : the arrays with their noise; `fresh()` gives a copy to run in
    ground_m : (ms,) float64, height under the tool that it should follow [m]
    first_ms : from here on the error is scored
    """

    profile: Profile
    speed_mps: float
    seed: int
    conditions: Conditions
    world: World
    run: NDArray[Any]
    ground_m: NDArray[np.float64]
    first_ms: int

    def fresh(self) -> tuple[Any, World]:
        """Return a run at its start: the `RUN` record and an unused world."""
        w = self.world
        z = np.empty_like(w.z)
        z[0] = w.z[0]
        return self.run.copy()[0], World(w.heights, w.reports.copy(), w.readings.copy(), w.orders.copy(), z)


def make_scene(
    profile: Profile,
    speed_mps: float,
    seed: int,
    conditions: Conditions,
    lost_s: tuple[tuple[float, float], ...] = (),
    stream: int = TEST_STREAM,
) -> Scene:
    """Prepare a run.

    Parameters
    ----------
    profile, speed_mps : surface and lateral speed [m/s]
    seed, stream : which noise; tests use `TEST_STREAM`, tuning `TRAINING_STREAM`
    conditions : see `Conditions`
    lost_s : drop-outs, (begin, end) [s] of the timestamps of readings that never come

    Raises
    ------
    UsageError
        when the speed is not positive or the path too short to be scored
    """
    if not (np.isfinite(speed_mps) and 1e-3 <= speed_mps <= 10.0):
        raise UsageError(f"speed {speed_mps} m/s, expected 0.001 to 10")
    if profile.length_m < 1.5 * conditions.unscored_m:
        raise UsageError(
            f"surface '{profile.name}' is {profile.length_m} m long, "
            f"expected at least {1.5 * conditions.unscored_m:g} m"
        )
    c = conditions
    duration_ms = int(profile.length_m / speed_mps * 1e3)
    rng = np.random.default_rng([stream, seed, 101])
    readings = np.zeros(_count(c.sensor.rate_hz, duration_ms), READING)
    if c.sensor.rate_hz > 1e3:
        _stamp_between(readings, c.sensor.rate_hz, c.sensor.latency_s)
    else:
        _stamp(readings, c.sensor.rate_hz, c.sensor.latency_s)
    readings["timestamp_ms"] = readings["ms"] - readings["early_ms"]
    n = len(readings)
    noise = c.sensor.sigma_m * rng.standard_normal(n)
    glitch = rng.random(n) < c.sensor.glitch_rate
    readings["noise"] = noise + glitch * rng.uniform(-c.sensor.glitch_m, c.sensor.glitch_m, n)
    for begin, end in lost_s:
        readings["noise"][(readings["ms"] >= begin * 1e3) & (readings["ms"] < end * 1e3)] = np.nan
    reports = np.zeros(_count(c.pose.rate_hz, duration_ms), REPORT)
    _stamp(reports, c.pose.rate_hz, c.pose.latency_s)
    rng = np.random.default_rng([stream, seed, 102])
    reports["noise_x"], reports["noise_z"] = c.pose.sigma_m * rng.standard_normal((2, len(reports)))

    x = np.asarray(profile.start_m + speed_mps * 1e-3 * np.arange(duration_ms), np.float64)
    ground = profile.desired_height_m(x)
    ticks = duration_ms // max(1, round(1e3 / c.plant.tick_hz)) + 1
    start_z = float(ground[0]) + c.standoff_m  # every run begins at the right height, at rest
    z = np.full(duration_ms, start_z)
    world = World(profile.heights_m, reports, readings, np.zeros(ticks, ORDER), z)
    run = np.zeros(1, RUN)
    run["axis"][0] = start_z, 0.0
    fields: dict[str, float] = {
        "end_ms": duration_ms,
        "tick_ms": max(1, round(1e3 / c.plant.tick_hz)),
        "newest": int(c.reference == "newest"),
        "speed_mps": speed_mps,
        "start_m": profile.start_m,
        "lead_m": c.lead_m,
        "profile_x0_m": profile.x0_m,
        "profile_dx_m": profile.dx_m,
        "tau_s": c.plant.tau_s,
        "v_max_mps": c.plant.v_max_mps,
        "a_max_mps2": c.plant.a_max_mps2,
        "near_m": c.sensor.near_m,
        "far_m": c.sensor.far_m,
        "quantum_m": (c.sensor.far_m - c.sensor.near_m) / 2**c.sensor.bits,
        "standoff_m": c.standoff_m,
        "setpoint_m": start_z,
    }
    for name, value in fields.items():
        run[name] = value
    first_ms = int(np.ceil(c.unscored_m / speed_mps * 1e3))
    return Scene(profile, speed_mps, seed, conditions, world, run, ground, first_ms)


def _count(rate_hz: float, duration_ms: int) -> int:
    """How often something happens that begins at 0 and happens `rate_hz` times a second."""
    return int(np.ceil((duration_ms - 0.5) * 1e-3 * rate_hz))


def _stamp(rows: NDArray[Any], rate_hz: float, latency_s: float) -> None:
    """Fill in timestamps and arrivals, in whole milliseconds."""
    rows["ms"] = np.round(np.arange(len(rows)) * 1e3 / rate_hz)
    rows["arrival_ms"] = rows["ms"] + round(latency_s * 1e3)


def _stamp_between(rows: NDArray[Any], rate_hz: float, latency_s: float) -> None:
    """Fill in timestamps between the steps of the simulation, and arrivals at the step after."""
    exact = np.arange(len(rows)) * 1e3 / rate_hz
    rows["ms"] = np.ceil(exact - 1e-9)
    rows["early_ms"] = np.maximum(rows["ms"] - exact, 0.0)
    rows["arrival_ms"] = np.ceil(exact + latency_s * 1e3 - 1e-9)
