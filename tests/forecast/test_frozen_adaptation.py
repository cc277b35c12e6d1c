"""`adapt = "frozen"` ends all learning once enough is known; without it the same run goes on learning."""

from __future__ import annotations

import math

import numpy as np

from surffollow import Follower
from surffollow.forecast.quantities import FULL_POWER_SAMPLES

MS, STANDOFF_M, TAU_S = 1_000_000, 0.1, 0.05
LEARNED = (  # record and field of the state
    ("plant", "tau_s"),
    ("plant", "error_m2"),
    ("latency", "correction_s"),
    ("noise", "sigma_m"),
    ("gate", "scale_m"),
    ("bank", "wave_number"),
    ("weights", "weight"),
    ("weights", "recent_m2"),
    ("preview", "error_m2"),
    ("preview", "offset_m2"),
)


def ground_m(x):
    """Waves that become twice as high and shorter behind 1 m."""
    return (0.004 if x < 1.0 else 0.008) * math.sin(2.0 * math.pi * x / (0.4 if x < 1.0 else 0.25))


def learned(adapt: str):
    """All that is learned, behind 500 scored samples and at the end of the run.

    The axis is quicker than configured. The tool travels; then it rests, and its stand-off goes up and down
    while the ranges are 12 ms older than their timestamps.
    """
    sensor = {"near_m": 0.03, "far_m": 0.3}
    plant = {"tau_s": 2.0 * TAU_S, "v_max_mps": 0.5, "a_max_mps2": 5.0}
    follower = Follower({"sensors": [sensor], "plant": plant, "adapt": adapt}, offset_m=STANDOFF_M)
    state = follower._state["adaptive"][0]
    rng, heights, enough = np.random.default_rng(5), [], None
    x, z = 0.0, STANDOFF_M
    for k in range(12_000):
        t_ns, speed_mps = 10**9 + k * MS, 0.15 if k < 8000 else 0.0
        follower.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        heights.append(z - ground_m(x))
        if k >= 8000 and k % 20 == 0:
            follower.set_params(offset_m=STANDOFF_M + 0.01 * math.sin(2.0 * math.pi * 1e-3 * k))
        if k % 4 == 0:
            old = heights[max(k - 12, 0)] if k >= 8000 else heights[-1]
            demand = follower.step(t_ns, [old + 3e-4 * rng.standard_normal()])[2]
            target = z + demand
        x += speed_mps * 1e-3
        z += (target - z) / TAU_S * 1e-3
        if enough is None and state["weights"]["scored"] >= FULL_POWER_SAMPLES:
            enough = {name: np.array(state[name[0]][name[1]]) for name in LEARNED}
    return enough, {name: np.array(state[name[0]][name[1]]) for name in LEARNED}


def test_nothing_is_learned_any_more_when_adaptation_is_frozen():
    before, after = learned("frozen")
    changed = [name for name in LEARNED if (before[name] != after[name]).any()]
    assert changed == []
    before, after = learned("learn")
    unchanged = [name for name in LEARNED if (before[name] == after[name]).all()]
    assert unchanged == []
