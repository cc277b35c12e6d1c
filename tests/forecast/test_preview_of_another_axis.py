"""Preview where the axis is not as configured, or where the reported heights scatter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from surffollow import Follower

STANDOFF_M, SPEED_MPS, LENGTH_M, TAU_S = 0.1, 0.1, 0.6, 0.04


@dataclass(frozen=True)
class Axis:
    """The axis that is configured, and what it is: quicker, weaker, or one that swings."""

    v_max_mps: float = 0.5
    a_max_mps2: float = 5.0
    tau_s: float = TAU_S
    real_a_mps2: float | None = None
    swings_hz: float = 0.0
    damping: float = 0.0


def passes(
    axis: Axis, boxes_m: float, memory: bool = True, noise_m: float = 0.0, lead_m: float = 0.0
) -> tuple[float, float, float]:
    """RMS error of the first and of the later passes over boxes [m], least clearance of those in stand-offs.

    Boxes are 60 mm long. Reported heights scatter by `noise_m`. The sensor is `lead_m` ahead.
    """
    rng = np.random.default_rng(1)
    config = {
        "sensors": [{"near_m": 0.03, "far_m": 0.3, "position_m": [lead_m, 0.0, 0.0]}],
        "plant": {"tau_s": TAU_S, "v_max_mps": axis.v_max_mps, "a_max_mps2": axis.a_max_mps2},
        "memory": memory,
    }
    f, z, climb, goal = Follower(config, offset_m=STANDOFF_M), STANDOFF_M, 0.0, STANDOFF_M
    a_max, errors = axis.real_a_mps2 or axis.a_max_mps2, ([], [])
    for ms in range(round(3e3 * LENGTH_M / SPEED_MPS)):
        number, way = divmod(1e-3 * ms * SPEED_MPS, LENGTH_M)
        x, half_turn = (LENGTH_M - way, math.pi / 2.0) if number == 1 else (way, 0.0)
        ground, ahead = (
            boxes_m if s > 0.0 and int(s / 0.06) % 3 == 1 else 0.0
            for s in (x, x + (-lead_m if number == 1 else lead_m))
        )
        if ms % 4 == 0:
            t_ns, reported = 10**10 + 1_000_000 * ms, z + noise_m * rng.standard_normal()
            f.pose(t_ns, (x, 0.0, reported, 0.0, 0.0, math.sin(half_turn), math.cos(half_turn)))
            goal = reported + float(f.step(t_ns, [z - ahead + 2.5e-4 * rng.standard_normal()])[2])
        if axis.swings_hz > 0.0:
            w = 2.0 * math.pi * axis.swings_hz
            accel = w * w * (goal - z) - 2.0 * axis.damping * w * climb
        else:
            accel = 1e3 * (min(max((goal - z) / axis.tau_s, -axis.v_max_mps), axis.v_max_mps) - climb)
        climb += 1e-3 * min(max(accel, -a_max), a_max)
        climb = min(max(climb, -axis.v_max_mps), axis.v_max_mps)
        z = max(z + 1e-3 * climb, ground)
        if ms > 1000:
            errors[number > 0].append(z - ground - STANDOFF_M)
    first, later = (float(np.sqrt(np.mean(np.square(e)))) for e in errors)
    return first, later, min(errors[1]) / STANDOFF_M + 1.0


@pytest.mark.parametrize("noise_m", [0.0, 0.3e-3, 0.5e-3])
def test_known_ground_is_used_where_reported_heights_scatter(noise_m):
    """GIVEN later passes over boxes WHEN reported heights scatter by up to 0.5 % of the stand-off.

    THEN they have their plans: reports more than 0.5 mm beside the axis models took them away for good.
    """
    first, later, _ = passes(Axis(), 0.02, noise_m=noise_m)
    print(f"first pass {1e3 * first:.2f} mm, later ones {1e3 * later:.2f} mm")
    assert later < 0.62 * first


@pytest.mark.parametrize(
    ("axis", "boxes_m"),
    [
        (Axis(0.5, 2.0, tau_s=0.02), 0.03),
        (Axis(0.5, 2.0, tau_s=0.01), 0.02),
        (Axis(1.0, 2.0, real_a_mps2=0.5), 0.03),
        (Axis(1.0, 5.0, real_a_mps2=1.0), 0.02),
        (Axis(1.0, 2.0, swings_hz=16.8, damping=0.127), 0.0086),
        (Axis(0.5, 2.0, swings_hz=6.0, damping=0.127), 0.0086),
        (Axis(0.5, 2.0, swings_hz=10.0, damping=0.3), 0.02),
    ],
    ids=["twice as quick", "four times", "a quarter of a", "a fifth of a", "17 Hz", "6 Hz", "10 Hz"],
)
def test_plans_do_not_swing_with_an_axis_that_is_not_as_configured(axis, boxes_m):
    """GIVEN an axis that brakes later than its model WHEN the ground is known THEN plans do not swing.

    A plan begins at the tool and brakes at the last moment. Without a limit of the error of the axis models
    the swing grew until the tool touched, VALID; with one of 3 mm it was 1.5 times as great.
    """
    _, rms_m, least = passes(axis, boxes_m)
    _, without_m, least_without = passes(axis, boxes_m, memory=False)
    print(
        f"RMS {1e3 * rms_m:.1f} mm, {1e3 * without_m:.1f} mm without; least {least:.2f}, {least_without:.2f}"
    )
    assert least > least_without - 0.06
    assert rms_m < 1.3 * without_m


@pytest.mark.parametrize(
    ("axis", "boxes_m"),
    [
        (Axis(0.5, 2.0, tau_s=0.02), 0.03),
        (Axis(1.0, 5.0, real_a_mps2=1.0), 0.02),
        (Axis(0.5, 2.0, swings_hz=6.0, damping=0.127), 0.0086),
        (Axis(0.5, 2.0, swings_hz=10.0, damping=0.3), 0.02),
    ],
    ids=["twice as quick", "a fifth of a", "6 Hz", "10 Hz"],
)
def test_a_lone_sensor_ahead_does_not_swing_with_such_an_axis(axis, boxes_m):
    """GIVEN the only sensor ahead WHEN the axis brakes later than its model THEN the tool does not swing.

    Such a sensor planned always: the error was 20 to 82 mm, the least clearance 0.00 to 0.59 stand-offs.
    """
    _, rms_m, least = passes(axis, boxes_m, memory=False, lead_m=0.05)
    print(f"RMS {1e3 * rms_m:.1f} mm, least {least:.2f}")
    assert least > 0.7
    assert rms_m < 18e-3
