"""Identify the age of ranges from the tool's vertical motion over one spot.

While the tool rests laterally and moves along z, a range that is δ older than its timestamp makes the
ground seem to rise by δ times the climb rate. A regression of the height on the climb rate gives δ. At the
end of the rest the result enters the correction, weighted by its variance. Motion along the ground is not
used: there climb rate and terrain are correlated.
"""

import math

from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.modes import adapts
from surffollow.forecast.plant import axis_model
from surffollow.forecast.pose import newest_pose, pose_at
from surffollow.forecast.quantities import CONFIRMATION_SAMPLES, FULL_POWER_SAMPLES, SLOW_RATE, USUAL_SAMPLES
from surffollow.forecast.sensing import kinematics
from surffollow.shm.jit import jit

MAX_LATENCY_S = 0.1  # greater ones have to be configured


@jit
def reset_window(latency):
    """Begin a new rest."""
    latency.count = latency.far = 0
    latency.mean_climb_mps = latency.mean_height_m = 0.0
    latency.climb_climb = latency.climb_height = latency.height_height = latency.step_step = 0.0


@jit
def update_delay(latency, delay_s, stamped_s, interval_s):
    """Update the usual and the least delay, and the slow mean, with a sample.

    Parameters
    ----------
    latency : record of `Latency` (updated)
    delay_s : float64     delay of the sample [s]
    stamped_s : float64   delay by its timestamp, without the correction [s]
    interval_s : float64  usual interval of samples [s]
    """
    if latency.known == 0:  # 0 is a delay, too: in process a sample may have none
        latency.delay_s = latency.least_s = delay_s
    latency.known += 1 if latency.known * SLOW_RATE < 1.0 else 0
    latency.mean_s += (stamped_s - latency.mean_s) / latency.known
    if latency.known * SLOW_RATE < 1.0 or latency.mean_s < latency.first_s:
        latency.first_s = latency.mean_s
    latency.delay_s += (delay_s - latency.delay_s) / USUAL_SAMPLES
    least_s = min(latency.least_s, delay_s)
    # it grows within 20 s: clocks drift by 100 ppm
    latency.least_s = least_s + min(interval_s / 20.0, 1.0) * (delay_s - least_s)


@jit
def is_late(adaptive):
    """Whether samples arrive later than they did: the delay grows, or the timestamps fall behind.

    The first means of several ranges are of fewer ones, and younger. Ground that is seen 2 τ late is behind
    the tool, and the axis has moved since. A clock that falls behind slowly makes the slow mean grow, which
    scatters less and is compared with that of the first samples. When that is long for the axis, the tool
    begins to swing.
    """
    latency, tau_s = adaptive.latency, adaptive.plant.tau_s
    younger_s = 0.5 * (adaptive.hold.readings - 1) * adaptive.hold.interval_s
    grown_s, drifted_s = latency.delay_s - latency.least_s, latency.mean_s - latency.first_s
    return grown_s > 2.0 * tau_s + younger_s or axis_model.is_long(drifted_s - younger_s, tau_s)


@jit
def check_configured_latency(params, latency):
    """Discard the correction when another latency or hold is configured; whether timestamps go back or on."""
    if latency.configured_ns == params.sensor_latency_ns and latency.hold_ns == params.hold_ns:
        return False
    latency.configured_ns, latency.hold_ns = params.sensor_latency_ns, params.hold_ns
    latency.correction_s = 0.0
    latency.known = 0  # delays are others
    reset_window(latency)
    return True


@jit
def update_correction(params, adaptive):
    """Let the regression of a rest enter the correction, and begin a new rest."""
    latency = adaptive.latency
    n = latency.count
    # deviations of the climb rate below 15 mm/s RMS identify nothing
    if adapts(params, adaptive) and n >= 3 * USUAL_SAMPLES and latency.climb_climb > n * 0.015**2:
        delta_s = latency.climb_height / latency.climb_climb
        residual = math.sqrt(max(latency.height_height - delta_s * latency.climb_height, 0.0) / n)
        noise_m = assumed_noise_m(adaptive.noise)
        # noise is left, or little of the change of height; otherwise the ground moved, or was not one spot
        left_m2 = n * residual * residual
        explained = left_m2 < latency.step_step or left_m2 < 0.1 * latency.height_height
        if abs(delta_s) < MAX_LATENCY_S and residual < 3.0 * noise_m + 0.5e-3 and explained:
            var = max(residual, noise_m) ** 2 / latency.climb_climb
            prior = 0.03**2  # variance of the latency before a rest [s²]
            corrected_s = latency.correction_s + prior / (prior + var) * delta_s
            latency.correction_s = min(max(corrected_s, -MAX_LATENCY_S), MAX_LATENCY_S)
    reset_window(latency)


@jit
def observe_height(params, adaptive, sense, t_ns, h_m, pose):
    """Enter a sample's height into the regression.

    One that is farther from the mean than MAX_LATENCY_S explains at 80 mm/s is a glitch. Several in a row end
    the rest: the ground moved, or the rest began with a glitch.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    t_ns : int64         timestamp minus the correction
    h_m : float64        height of the footprint with the pose at that time [m]
    pose : (7,) float64  scratch
    """
    latency, at_rest = adaptive.latency, kinematics.is_at_rest(adaptive.kinematics)
    far = latency.count > 0 and abs(h_m - latency.mean_height_m) > MAX_LATENCY_S * 0.08
    latency.far = latency.far + 1 if far else 0
    if latency.far >= CONFIRMATION_SAMPLES:
        update_correction(params, adaptive)
        far = False
    if at_rest and not far:
        newest_ns = sense.pose_t_ns[newest_pose(sense)]
        end_ns = min(t_ns + kinematics.CLIMB_WINDOW_NS // 2, newest_ns)
        pose_at(sense, end_ns - kinematics.CLIMB_WINDOW_NS, pose)
        z = pose[2]
        pose_at(sense, end_ns, pose)
        climb = (pose[2] - z) / (1e-9 * kinematics.CLIMB_WINDOW_NS)
        latency.count += 1
        dc, dh = climb - latency.mean_climb_mps, h_m - latency.mean_height_m
        latency.mean_climb_mps += dc / latency.count
        latency.mean_height_m += dh / latency.count
        latency.climb_climb += dc * (climb - latency.mean_climb_mps)
        latency.climb_height += dc * (h_m - latency.mean_height_m)
        latency.height_height += dh * (h_m - latency.mean_height_m)
        if latency.count > 1:
            latency.step_step += (h_m - latency.newest_m) ** 2  # of white noise: twice its sum of squares
        latency.newest_m = h_m
    if not at_rest or latency.count >= FULL_POWER_SAMPLES:
        update_correction(params, adaptive)
