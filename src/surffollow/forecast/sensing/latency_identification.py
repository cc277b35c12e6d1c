"""Identify the age of ranges from the tool's vertical motion over one spot.

While the tool rests laterally and moves along z, a range that is δ older than its timestamp makes the
ground seem to rise by δ times the climb rate. A regression of the height on the climb rate gives δ. At the
end of the rest the result enters the correction, weighted by its variance. Motion along the ground is not
used: there climb rate and terrain are correlated.
"""

import math

from surffollow.forecast.pose import pose_at
from surffollow.shm.jit import jit

PRIOR_S = 0.03  # standard deviation of the configured latency
HALF_SPAN_NS = 15_000_000  # climb rate at a sample: between the poses so long before and after
MIN_SAMPLES = 20  # fewer give no significant regression
MAX_SAMPLES = 500  # samples after which a rest is concluded
MIN_CLIMB_RMS_MPS = 0.015  # RMS deviation of the climb rate: less identifies nothing
OUTLIER_GATE_M = 8e-3  # heights so far from the mean are glitches
MAX_CORRECTION_S = 0.1  # greater latencies have to be configured
RESIDUAL_LIMIT_M = 0.5e-3  # left by the regression, beyond the noise: the ground was not one spot
DRIFT_S = 1e-3  # standard deviation of the latency's drift between two rests
USUAL_VALUE_RATE = 0.05  # of the usual delay, lead and spacing, per sample
LEAST_DELAY_S = 20.0  # time constant of the least delay, which grows: clocks drift by 100 ppm
LATE_TAUS = 2.0  # usual beyond least delay: ground seen so late is behind the tool, and the axis moved since


@jit
def reset_window(latency):
    """Begin a new rest."""
    latency.count = 0
    latency.mean_climb_mps = latency.mean_height_m = latency.climb_climb = latency.climb_height = (
        latency.height_height
    ) = 0.0


@jit
def update_delay(latency, delay_s, interval_s):
    """Update the usual and the least delay with that of a sample, at the usual interval [s]."""
    latency.delay_s += USUAL_VALUE_RATE * (delay_s - latency.delay_s)
    if latency.least_s == 0.0 or delay_s < latency.least_s:
        latency.least_s = delay_s
    latency.least_s += min(interval_s / LEAST_DELAY_S, 1.0) * (delay_s - latency.least_s)


@jit
def is_late(params, adaptive):
    """Whether samples arrive later than they did: the delay grows, or the timestamps fall behind.

    The first means of a channel are of fewer ranges, and younger.
    """
    latency = adaptive.latency
    younger_s = 0.5 * (params.sensor_readings - 1) * adaptive.prediction.interval_s
    return latency.delay_s - latency.least_s > LATE_TAUS * adaptive.plant.tau_s + younger_s


@jit
def reset_delay(latency):
    """Discard the usual delay."""
    latency.delay_s = latency.least_s = 0.0


@jit
def discard_correction(latency):
    """Discard the correction and begin a new rest."""
    latency.correction_s = latency.sigma_s = 0.0
    reset_window(latency)


@jit
def check_configured_latency(params, latency):
    """Discard the correction when another latency is configured; whether it is: timestamps go back or on."""
    if latency.configured_ns == params.sensor_latency_ns:
        return False
    latency.configured_ns = params.sensor_latency_ns
    discard_correction(latency)
    return True


@jit
def update_correction(adaptive, adapt):
    """Let the regression of a rest enter the correction, and begin a new rest."""
    latency = adaptive.latency
    n = latency.count
    if adapt and n >= MIN_SAMPLES and latency.climb_climb > n * MIN_CLIMB_RMS_MPS * MIN_CLIMB_RMS_MPS:
        delta = latency.climb_height / latency.climb_climb
        residual = math.sqrt(max(latency.height_height - delta * latency.climb_height, 0.0) / n)
        noise = max(adaptive.noise.sigma_m, 1e-4)
        if abs(delta) < MAX_CORRECTION_S and residual < 3.0 * noise + RESIDUAL_LIMIT_M:
            var = max(residual, noise) ** 2 / latency.climb_climb
            prior = PRIOR_S if latency.sigma_s == 0.0 else math.sqrt(latency.sigma_s**2 + DRIFT_S**2)
            gain = prior * prior / (prior * prior + var)
            latency.correction_s = min(
                max(latency.correction_s + gain * delta, -MAX_CORRECTION_S), MAX_CORRECTION_S
            )
            latency.sigma_s = math.sqrt((1.0 - gain) * prior * prior)
    reset_window(latency)


@jit
def observe_height(adaptive, sense, t_ns, h_m, at_rest, adapt, pose):
    """Enter a sample's height into the regression.

    Parameters
    ----------
    adaptive, sense : records of `AdaptiveState` (updated), `SenseState`
    t_ns : int64         timestamp minus the correction
    h_m : float64        height of the footprint with the pose at that time [m]
    at_rest : bool       the tool rests laterally
    adapt : bool         False: the correction stays
    pose : (7,) float64  scratch
    """
    latency = adaptive.latency
    if not at_rest:
        if latency.count > 0:
            update_correction(adaptive, adapt)
        return
    pose_at(sense, t_ns - HALF_SPAN_NS, 1, pose)
    z = pose[2]
    pose_at(sense, t_ns + HALF_SPAN_NS, 1, pose)
    climb = (pose[2] - z) / (2e-9 * HALF_SPAN_NS)
    if latency.count > 0 and abs(h_m - latency.mean_height_m) > OUTLIER_GATE_M:
        return
    latency.count += 1
    dc, dh = climb - latency.mean_climb_mps, h_m - latency.mean_height_m
    latency.mean_climb_mps += dc / latency.count
    latency.mean_height_m += dh / latency.count
    latency.climb_climb += dc * (climb - latency.mean_climb_mps)
    latency.climb_height += dc * (h_m - latency.mean_height_m)
    latency.height_height += dh * (h_m - latency.mean_height_m)
    if latency.count >= MAX_SAMPLES:
        update_correction(adaptive, adapt)
