"""Identify the age of ranges from the tool's vertical motion over one spot.

While the tool rests laterally and moves along z, a range that is δ older than its timestamp makes the
ground seem to rise by δ times the climb rate. A regression of the height on the climb rate gives δ. At the
end of the rest the result enters the correction, weighted by its variance. Motion along the ground is not
used: there climb rate and terrain are correlated.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.pose import pose_at
from surffollow.shm.jit import jit

PRIOR_S = 0.03  # how wrong the configured latency may well be
HALF_SPAN_NS = 15_000_000  # climb at a sample: between the poses so long before and after
MIN_SAMPLES = 20
MAX_SAMPLES = 500  # samples after which a rest is concluded
MIN_CLIMB_RMS_MPS = 0.015  # RMS deviation of the climb: less tells nothing
OUTLIER_GATE_M = 8e-3  # heights so far from the mean are glitches
MAX_CORRECTION_S = 0.1
RESIDUAL_LIMIT_M = 0.5e-3  # left by the regression, beyond the noise: the ground was not one spot
DRIFT_S = 1e-3  # the lag may wander by as much from rest to rest


@jit
def reset_window(a: Any) -> None:
    """Begin anew."""
    a.rest_n = 0
    a.rest_climb_mps = a.rest_h_m = a.rest_cc = a.rest_ch = a.rest_hh = 0.0


@jit
def check_configured_latency(params: Any, a: Any) -> None:
    """What was found beside another configured latency is no correction of this one: find it anew."""
    if a.latency_assumed_ns != params.sensor_latency_ns:
        a.latency_assumed_ns = params.sensor_latency_ns
        a.older_s = a.older_sigma_s = 0.0
        reset_window(a)


@jit
def update_correction(a: Any, adapt: Any) -> None:
    """Let what a rest told enter the lag, and begin anew."""
    n = a.rest_n
    if adapt != 0 and n >= MIN_SAMPLES and a.rest_cc > n * MIN_CLIMB_RMS_MPS * MIN_CLIMB_RMS_MPS:
        wrong = a.rest_ch / a.rest_cc
        left = math.sqrt(max(a.rest_hh - wrong * a.rest_ch, 0.0) / n)
        noise = max(a.noise_m, 1e-4)
        if abs(wrong) < MAX_CORRECTION_S and left < 3.0 * noise + RESIDUAL_LIMIT_M:
            var = max(left, noise) ** 2 / a.rest_cc
            prior = PRIOR_S if a.older_sigma_s == 0.0 else math.sqrt(a.older_sigma_s**2 + DRIFT_S**2)
            gain = prior * prior / (prior * prior + var)
            a.older_s = min(max(a.older_s + gain * wrong, -MAX_CORRECTION_S), MAX_CORRECTION_S)
            a.older_sigma_s = math.sqrt((1.0 - gain) * prior * prior)
    reset_window(a)


@jit
def observe_height(a: Any, sense: Any, t_ns: Any, h_m: Any, still: Any, adapt: Any, pose: Any) -> None:
    """Take a sample's height, made with the pose at its stamp less the lag found so far.

    Parameters
    ----------
    a, sense : records of `AdaptiveState` (updated), `SenseState`
    t_ns : int64       stamp less the lag
    h_m : float64      height [m]
    still : int        1: the tool rests laterally
    adapt : int        0: learn nothing
    pose : (7,) float64 scratch
    """
    if still == 0:
        if a.rest_n > 0:
            update_correction(a, adapt)
        return
    pose_at(sense, t_ns - HALF_SPAN_NS, 1, pose)
    z = pose[2]
    pose_at(sense, t_ns + HALF_SPAN_NS, 1, pose)
    climb = (pose[2] - z) / (2e-9 * HALF_SPAN_NS)
    if a.rest_n > 0 and abs(h_m - a.rest_h_m) > OUTLIER_GATE_M:
        return
    a.rest_n += 1
    dc, dh = climb - a.rest_climb_mps, h_m - a.rest_h_m
    a.rest_climb_mps += dc / a.rest_n
    a.rest_h_m += dh / a.rest_n
    a.rest_cc += dc * (climb - a.rest_climb_mps)
    a.rest_ch += dc * (h_m - a.rest_h_m)
    a.rest_hh += dh * (h_m - a.rest_h_m)
    if a.rest_n >= MAX_SAMPLES:
        update_correction(a, adapt)
