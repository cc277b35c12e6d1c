"""Preview: ground under the tool in the coming controller periods, and its share of the setpoint."""

import math

from surffollow.forecast.estimation import model_bank, model_weights
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.modes import adapts
from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.quantities import USUAL_SAMPLES
from surffollow.forecast.sensing.kinematics import is_at_rest
from surffollow.forecast.terrain import known_ground, terrain_buffer
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON

PREDICTION_M = 0.04  # over which predictions by the bank are compared; farther on they end


@jit
def bank_rise(adaptive, ahead_m):
    """Blended change of height from the newest sample to a point ahead of it [m]."""
    model_bank.extrapolate_bank(adaptive.bank, ahead_m)
    return model_weights.blended(adaptive, adaptive.bank.rise_m)


@jit
def observe_ground(params, adaptive, h_m):
    """Compare an accepted height with its prediction, one after the other; predict the next one.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`preview` updated)
    h_m : float64  the height [m]
    """
    preview, s = adaptive.preview, adaptive.estimate.arc_length_m
    if s < preview.predicted_from_m + PREDICTION_M:
        return
    offset, error = h_m - preview.mean_m, h_m - preview.predicted_m
    preview.mean_m += 1.0 / USUAL_SAMPLES * offset
    if s > preview.predicted_from_m + 2.0 * PREDICTION_M:
        preview.mean_m = h_m
    elif adapts(params, adaptive):  # otherwise only the recent mean is updated
        preview.offset_m2 += 1.0 / USUAL_SAMPLES * (offset * offset - preview.offset_m2)
        preview.error_m2 += 1.0 / USUAL_SAMPLES * (error * error - preview.error_m2)
    preview.predicted_m, preview.predicted_from_m = h_m + bank_rise(adaptive, PREDICTION_M), s


@jit
def extrapolate_ground(adaptive, known_periods, ahead_m):
    """Fill `preview.ground_m` beyond the known points as the model bank continues, by 45° at most.

    The height returns to the recent mean in proportion to the share of the error of such predictions: from
    there an axis with bounded acceleration reaches any height soonest.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`preview` updated)
    known_periods : int      of `preview.ground_m`, ≥ 1
    ahead_m : float64        point 0, ahead of the newest sample [m]
    """
    preview, step = adaptive.preview, adaptive.kinematics.speed_mps * PERIOD_S
    ground = preview.ground_m
    last, end_m = ground[known_periods - 1], ahead_m + step * (known_periods - 1)
    before = bank_rise(adaptive, end_m)
    noise_m2 = assumed_noise_m(adaptive.noise) ** 2
    reversion = 1.5 * preview.error_m2 / (preview.error_m2 + preview.offset_m2 + noise_m2)
    for k in range(known_periods, HORIZON):
        x = step * (k + 1 - known_periods)
        if x > 2.0 * PREDICTION_M:
            ground[k] = ground[k - 1]
            continue
        rise = bank_rise(adaptive, end_m + min(x, PREDICTION_M)) - before
        rise -= (last + rise - preview.mean_m) * min(reversion * x / PREDICTION_M, 1.0)
        ground[k] = last + min(max(rise, -x), x)


@jit
def collect_preview(adaptive, inputs, s_m, ahead_m):
    """Fill `preview.ground_m` with the ground per controller period; returns the known periods.

    Parameters
    ----------
    adaptive, inputs : records of `AdaptiveState` (`preview` updated), `Inputs`
    s_m : float64        arc length of the point under the tool at the latch time [m]
    ahead_m : float64    distance of that point ahead of the one under the newest pose [m]
    """
    # ground that is known from channel 0 has no bias, and is not to be confirmed
    known, ground, leads = adaptive.known, adaptive.preview.ground_m, terrain_buffer.sensor_leads(adaptive)
    if not leads and adaptive.estimate.arc_length_m < known.trusted_from_m:
        return 0
    if leads and is_at_rest(adaptive.kinematics):
        ground[:] = known_ground.height_at_rest(adaptive, s_m)
        return HORIZON if math.isfinite(ground[0]) else 0
    bias_m, known_periods = 0.0 if leads else known.bias_m[known_ground.known_source(adaptive)], 0
    for k in range(HORIZON):
        travel = adaptive.kinematics.speed_mps * PERIOD_S * k
        ground[k] = known_ground.known_height(adaptive, inputs, s_m + travel, ahead_m + travel) + bias_m
        if k == known_periods and math.isfinite(ground[k]):
            known_periods += 1
    return known_periods


@jit
def update_share(adaptive, known_periods):
    """Raise or lower preview's share of the setpoint by one controller period; whether there is a share.

    To raise it takes known ground over the reaction time of the axis, seven periods. Ground that ends is
    planned while the share fades.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`preview` updated)
    known_periods : int  of ground ahead
    """
    preview, leads = adaptive.preview, terrain_buffer.sensor_leads(adaptive)
    sure = adaptive.clock.now_ns >= preview.suspended_until_ns and known_ground.is_useful(adaptive)
    # the distance ahead of a lone sensor may be just as long: one period less does not end the plan
    usable = known_periods >= (7 if preview.share == 0.0 else 6) and sure
    # a mixture of the blend and a plan catches up too fast where such a sensor begins
    rise = 1.0 if leads else 0.15
    preview.share += rise if usable else -0.15
    preview.share = min(max(preview.share, 0.0), 1.0 if known_periods > 0 else 0.0)
    preview.sensed_periods = known_periods if leads else 0
    return preview.share > 0.0


@jit
def suspend_preview(preview, until_ns):
    """Suspend preview until a time: a plan inverts the axis model, and swings with another axis."""
    preview.suspended_until_ns = until_ns


@jit
def withdraw_preview(preview):
    """Set preview's share to zero at once: its plan does not apply any more."""
    preview.sensed_periods = 0
    preview.share = 0.0
