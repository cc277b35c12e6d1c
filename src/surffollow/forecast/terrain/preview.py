"""Preview: terrain ahead of the tool, from a look-ahead sensor or from a map, and its share of the setpoint.

Heights of a look-ahead sensor are in the terrain buffer. Heights of a map are an input of the cycle, at equal
distances ahead of the point under the newest pose.
"""

import math

from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.terrain.known_ground import DISAGREEMENT_M, REGISTRATION_M, compare_known_ground
from surffollow.forecast.terrain.terrain_buffer import buffered_height
from surffollow.forecast.terrain.terrain_regression import DISTANCES_M, RISE_LENGTH_M, predict_rise
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON
from surffollow.shm.layout_adaptive_estimation import N_DISTANCES

MIN_KNOWN_PERIODS = 7  # known ground that a plan needs: the reaction time of the axis
SHARE_RATE = 0.15  # per controller period: preview fades in and out
MAP_BIAS_RATE = 0.002  # per sample: a constant bias is learned in 2 s at 250 Hz
MAP_DEVIATION_RATE = 0.02  # per sample
MAX_MODEL_ERROR_M2 = 4e-8  # (0.2 mm)²: beyond, the axis model is too wrong for a plan
LEADING_MAX_MODEL_ERROR_M2 = 1e-6  # (1 mm)²
CONTRADICTION_NS = 100_000_000  # the map is not used for so long after samples that contradict it


@jit
def extrapolate_ground(adaptive, known, from_m, bias_m):
    """Fill `preview.ground_m` beyond the known points by the terrain regression.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    known : int              known points of `preview.ground_m`, ≥ 1
    from_m : float64         arc length of point 0 [m]
    bias_m : float64         what was added to the buffered heights; the regression is without it [m]
    """
    kinematics, regression, preview = adaptive.kinematics, adaptive.regression, adaptive.preview
    last = preview.ground_m[known - 1]
    offset = last - regression.mean_height_m
    rise = (
        last
        - bias_m
        - buffered_height(adaptive, from_m + kinematics.speed_mps * PERIOD_S * (known - 1) - RISE_LENGTH_M)
    )
    x0, x1, change0, change1, j = 0.0, 0.0, 0.0, 0.0, 0
    for k in range(known, HORIZON):
        x = kinematics.speed_mps * PERIOD_S * (k + 1 - known)
        while x > x1 and j < N_DISTANCES:
            x0, change0 = x1, change1
            x1 = DISTANCES_M[j]
            change1 = predict_rise(regression, j, offset, rise) if math.isfinite(rise) else 0.0
            j += 1
        f = min((x - x0) / (x1 - x0), 1.0) if x1 > x0 else 0.0
        preview.ground_m[k] = last + change0 + f * (change1 - change0)


@jit
def map_height(inputs, ahead_m):
    """Height of the map at a distance ahead of the point under the tool [m]; NaN when unknown."""
    step = inputs.preview_step_m
    if inputs.n_preview < 2 or not step > 0.0:
        return math.nan
    f = (ahead_m - inputs.preview_from_m) / step
    if not 0.0 <= f < inputs.n_preview - 1:
        return math.nan
    i = int(f)
    return inputs.preview_m[i] * (1.0 - (f - i)) + inputs.preview_m[i + 1] * (f - i)


@jit
def collect_preview(adaptive, inputs, leading, ahead_m, since_pose_m, bias_m):
    """Fill `preview.ground_m` with the ground per controller period; returns the known periods.

    Parameters
    ----------
    leading : bool           from the terrain buffer; False: from the map in the inputs
    ahead_m : float64        point under the tool at the latch time, ahead of the newest footprint [m]
    since_pose_m : float64   distance travelled since the newest report, at that time [m]
    bias_m : float64         added to the buffered heights [m]
    """
    preview = adaptive.preview
    known = 0
    for k in range(HORIZON):
        travel = adaptive.kinematics.speed_mps * PERIOD_S * k
        if leading:
            h = buffered_height(adaptive, adaptive.estimate.arc_length_m + ahead_m + travel) + bias_m
        else:
            h = map_height(inputs, since_pose_m + travel) + preview.map_bias_m
        preview.ground_m[k] = h
        if k == known and math.isfinite(h):
            known += 1
    return known


@jit
def compare_map(adaptive, inputs, ahead_m, h_m):
    """Compare the map with a sample's height: update bias and deviation.

    A map that lies below the sample pulls the tool toward the surface. Several such samples in a row
    withdraw the preview at once.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`preview`, `known` updated)
    inputs : record of `Inputs`
    ahead_m : float64  place of the sample, ahead of the point under the tool [m]
    h_m : float64      height of the sample [m]
    """
    preview = adaptive.preview
    map_m = map_height(inputs, ahead_m)
    if not math.isfinite(map_m):
        return
    height_behind_m = map_height(inputs, ahead_m - REGISTRATION_M)
    height_ahead_m = map_height(inputs, ahead_m + REGISTRATION_M)
    if compare_known_ground(adaptive, height_behind_m, map_m, height_ahead_m, h_m - preview.map_bias_m):
        withdraw_preview(preview)
        suspend_preview(preview, adaptive.clock.now_ns + CONTRADICTION_NS)
    e = h_m - map_m
    preview.map_deviation_m += MAP_DEVIATION_RATE * (
        min(abs(e - preview.map_bias_m), 0.02) - preview.map_deviation_m
    )
    preview.map_bias_m += MAP_BIAS_RATE * (min(max(e, -0.02), 0.02) - preview.map_bias_m)


@jit
def update_share(adaptive, known, leading, plant_m2):
    """Raise or lower preview's share of the setpoint by one controller period.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`preview` updated)
    known : int         known periods of ground
    leading : bool      the ground is known from a sensor that leads
    plant_m2 : float64  squared error of the best axis model [m²]
    """
    # with a sensor that leads, an uncertain plan is better than none
    preview = adaptive.preview
    trusted = (
        adaptive.clock.now_ns >= preview.suspended_until_ns
        and plant_m2 < MAX_MODEL_ERROR_M2
        and preview.map_deviation_m < DISAGREEMENT_M
    )
    usable = known >= MIN_KNOWN_PERIODS and (trusted or (leading and plant_m2 < LEADING_MAX_MODEL_ERROR_M2))
    preview.share += SHARE_RATE if usable else -SHARE_RATE
    preview.share = min(max(preview.share, 0.0), 1.0 if known > 0 else 0.0)
    preview.sensed_periods = known if leading else 0


@jit
def suspend_preview(preview, until_ns):
    """Suspend preview until a time, or until later if that was set before."""
    preview.suspended_until_ns = max(preview.suspended_until_ns, until_ns)


@jit
def withdraw_preview(preview):
    """Set preview's share to zero at once: its plan does not apply any more."""
    preview.sensed_periods = 0
    preview.share = 0.0
