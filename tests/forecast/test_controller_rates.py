"""A sensor that leads, under controllers of any rate: plans begin at the axis that the reports will show."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

TAU_S, V_MAX_MPS, STANDOFF_M, LEAD_M, SPEED_MPS = 0.04, 0.5, 0.1, 0.05, 0.4


def ground_m(x: float) -> float:
    """Hills with velocities to 0.08 m/s and accelerations to 1.4 m/s²."""
    return 4e-3 * math.sin(2 * math.pi * x / 0.25) + 2e-3 * math.sin(2 * math.pi * x / 0.11 + 1)


def rms_m(period_ms: int, reading_ms: int, latency_ms: int, a_max_mps2: float) -> float:
    """RMS error of a sensor without noise; a report is `latency_ms` old when it arrives."""
    plant = {"tau_s": TAU_S, "v_max_mps": V_MAX_MPS, "a_max_mps2": a_max_mps2}
    sensor = {"near_m": 0.03, "far_m": 0.3, "position_m": [LEAD_M, 0.0, 0.0]}
    f = Follower({"plant": plant, "sensors": [sensor]}, offset_m=STANDOFF_M)
    z = target = ground_m(0.0) + STANDOFF_M
    v, places, errors = 0.0, [], []
    for ms in range(4000):
        t_ns, x = 10**9 + ms * 1_000_000, SPEED_MPS * 1e-3 * ms
        places.append((x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        reported = places[max(ms - latency_ms, 0)]
        if ms % period_ms == 0 and ms >= latency_ms:
            f.pose(t_ns - latency_ms * 1_000_000, reported)
        if ms % reading_ms == 0:
            f.step(t_ns, [z - ground_m(x + LEAD_M)])
        if ms % period_ms == 0:
            target = reported[2] + float(f.step(t_ns, [math.nan])[2])
        wanted = min(max((target - z) / TAU_S, -V_MAX_MPS), V_MAX_MPS)
        v += min(max(wanted - v, -a_max_mps2 * 1e-3), a_max_mps2 * 1e-3)
        z += v * 1e-3
        if ms >= 2000:
            errors.append(z - ground_m(x) - STANDOFF_M)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("latency_ms", [0, 4, 10])
@pytest.mark.parametrize(
    ("period_ms", "reading_ms"), [(2, 2), (4, 4), (7, 7), (2, 1), (4, 1), (10, 1), (20, 1)]
)
@pytest.mark.parametrize("a_max_mps2", [5.0, 20.0])
def test_a_leading_sensor_is_followed_under_a_controller_of_any_rate(
    period_ms, reading_ms, latency_ms, a_max_mps2
):
    error = rms_m(period_ms, reading_ms, latency_ms, a_max_mps2)
    print(f"{1000 / period_ms:.0f} Hz, reports {latency_ms} ms old: {1e3 * error:.2f} mm")
    assert error < 0.15e-3 + 0.01e-3 * (period_ms + latency_ms)
