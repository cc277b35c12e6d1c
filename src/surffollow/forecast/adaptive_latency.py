"""Find out how old ranges really are: over one spot of ground they must not follow the tool's climbing.

While the tool rests laterally but moves up or down (the approach to a surface does), a range that is δ
older than its stamp says makes the ground seem to rise by δ times the climb. The regression of the height
on the climb gives δ; when the rest ends, what was found enters the estimate by its uncertainty. Travelling
over ground teaches nothing: there the tool's climb and the ground's shape go together. A latency that is
set by hand is taken at its word.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.pose import pose_at
from surffollow.shm.jit import jit

PRIOR_S = 0.03  # how wrong the configured latency may well be
HALF_SPAN_NS = 15_000_000  # climb at a sample: between the poses so long before and after
LEAST_SAMPLES = 20
ENOUGH = 500  # samples after which a rest is concluded
LEAST_CLIMB_MPS = 0.015  # RMS deviation of the climb: less tells nothing
ODD_M = 8e-3  # heights so far from the mean are glitches
MOST_S = 0.1
RESIDUAL_M = 0.5e-3  # left by the regression, beyond the noise: the ground was not one spot
DRIFT_S = 1e-3  # the lag may wander by as much from rest to rest


@jit
def forget_rest(a: Any) -> None:
    """Begin anew."""
    a.rest_n = 0
    a.rest_climb_mps = a.rest_h_m = a.rest_cc = a.rest_ch = a.rest_hh = 0.0


@jit
def assume_latency(params: Any, a: Any) -> None:
    """What was found beside another configured latency is no correction of this one: find it anew."""
    if a.latency_assumed_ns != params.sensor_latency_ns:
        a.latency_assumed_ns = params.sensor_latency_ns
        a.older_s = a.older_sigma_s = 0.0
        forget_rest(a)


@jit
def conclude_rest(a: Any, adapt: Any) -> None:
    """Let what a rest told enter the lag, and begin anew."""
    n = a.rest_n
    if adapt != 0 and n >= LEAST_SAMPLES and a.rest_cc > n * LEAST_CLIMB_MPS * LEAST_CLIMB_MPS:
        wrong = a.rest_ch / a.rest_cc
        left = math.sqrt(max(a.rest_hh - wrong * a.rest_ch, 0.0) / n)
        noise = max(a.noise_m, 1e-4)
        if abs(wrong) < MOST_S and left < 3.0 * noise + RESIDUAL_M:
            var = max(left, noise) ** 2 / a.rest_cc
            prior = PRIOR_S if a.older_sigma_s == 0.0 else math.sqrt(a.older_sigma_s**2 + DRIFT_S**2)
            gain = prior * prior / (prior * prior + var)
            a.older_s = min(max(a.older_s + gain * wrong, -MOST_S), MOST_S)
            a.older_sigma_s = math.sqrt((1.0 - gain) * prior * prior)
    forget_rest(a)


@jit
def learn_lag(a: Any, sense: Any, t_ns: Any, h_m: Any, still: Any, adapt: Any, pose: Any) -> None:
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
            conclude_rest(a, adapt)
        return
    pose_at(sense, t_ns - HALF_SPAN_NS, 1, pose)
    z = pose[2]
    pose_at(sense, t_ns + HALF_SPAN_NS, 1, pose)
    climb = (pose[2] - z) / (2e-9 * HALF_SPAN_NS)
    if a.rest_n > 0 and abs(h_m - a.rest_h_m) > ODD_M:
        return
    a.rest_n += 1
    dc, dh = climb - a.rest_climb_mps, h_m - a.rest_h_m
    a.rest_climb_mps += dc / a.rest_n
    a.rest_h_m += dh / a.rest_n
    a.rest_cc += dc * (climb - a.rest_climb_mps)
    a.rest_ch += dc * (h_m - a.rest_h_m)
    a.rest_hh += dh * (h_m - a.rest_h_m)
    if a.rest_n >= ENOUGH:
        conclude_rest(a, adapt)
