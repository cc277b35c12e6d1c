"""Known ground: heights ahead of the tool from a look-ahead sensor or a map, and whether they hold.

A look-ahead sensor fills the terrain buffer. Heights of a map or of the terrain memory are an input of the
cycle. Where known ground lies below what channel 0 measures, preview would pull the tool toward the surface.
"""

import math

from surffollow.forecast.plant.axis_model import is_long
from surffollow.forecast.quantities import APART_M, QUICK_RATE, SLOW_RATE
from surffollow.forecast.sensing.kinematics import path_speed
from surffollow.forecast.terrain.terrain_buffer import CELL_M, buffered_height, height_at, sensor_leads
from surffollow.shm.jit import jit

DISAGREEMENT_M = 1.5e-3  # heights of one place that differ by more disagree, but for noise
REGISTRATION_M = 2.0 * CELL_M  # error of the place of a known height
MAX_UNCONFIRMED_DESCENT_M = 2.0 * DISAGREEMENT_M  # of a plan below the setpoint of the sensor under the tool


@jit
def known_source(adaptive):
    """Source of known ground: 0 a sensor that leads, 1 the map or the terrain memory. Each has its bias."""
    return 0 if adaptive.lookahead.ahead_m > 0.0 or sensor_leads(adaptive) else 1


@jit
def known_height(adaptive, inputs, s_m, ahead_m):
    """Height of a place as the look-ahead sensor or the map has it [m]; NaN where it has none.

    Parameters
    ----------
    adaptive, inputs : records of `AdaptiveState`, `Inputs`
    s_m : float64      arc length of the place, for the terrain buffer [m]
    ahead_m : float64  its distance ahead of the point under the newest pose, for the map [m]
    """
    if known_source(adaptive) == 0:
        return buffered_height(adaptive, s_m)
    f = (ahead_m - inputs.preview_from_m) / inputs.preview_step_m
    if not 0.0 <= f < inputs.n_preview - 1:  # nor where there is no preview
        return math.nan
    i = int(f)
    return inputs.preview_m[i] * (1.0 - (f - i)) + inputs.preview_m[i + 1] * (f - i)


@jit
def height_at_rest(adaptive, s_m):
    """Height under a tool that rests behind its only sensor [m]; NaN where it is not known, or moves.

    The sensor measured it before. It moves where the height ahead differs from that of before, or will in τ.
    """
    estimate, before_m = adaptive.estimate, height_at(adaptive, adaptive.estimate.arc_length_m)
    moves_m = abs(estimate.slope) * path_speed(adaptive.kinematics) * adaptive.plant.tau_s
    stays = abs(estimate.height_m - before_m) + moves_m < disagreement_m(adaptive)
    return height_at(adaptive, s_m) if stays else math.nan


@jit
def disagreement_m(adaptive):
    """Difference from which two heights of one place disagree [m]."""
    return max(DISAGREEMENT_M, 6.0 * adaptive.noise.sigma_m)


@jit
def _confirm_drop(adaptive, h_m, agrees, length_m):
    """Let plans descend by a drop of the ground that was known, when the newest sample confirms it.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`known` updated)
    h_m : float64       height of the sample [m]
    agrees : bool       known ground is as high
    length_m : float64  over which a drop is taken [m]
    """
    known, spacing_m = adaptive.known, adaptive.kinematics.speed_mps * adaptive.hold.interval_s
    fading = min(spacing_m / length_m, 1.0) if known.peak_m != 0.0 else 1.0
    known.peak_m = max(known.peak_m + (h_m - known.peak_m) * fading, h_m)
    drop_m = known.peak_m - h_m
    if agrees and drop_m > MAX_UNCONFIRMED_DESCENT_M:
        known.descent_m += fading * max(drop_m - known.descent_m, 0.0)


@jit
def compare_known_ground(adaptive, inputs, ahead_m, h_m):
    """Compare the newest sample of channel 0 with known ground; whether two in a row contradict it.

    Then known ground is used again beyond all that the look-ahead sensor has measured, or farther on in the
    map.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`known` updated)
    inputs : record of `Inputs`
    ahead_m : float64  place of the sample, ahead of the point under the newest pose [m]
    h_m : float64      height of the sample [m]
    """
    known, source, s = adaptive.known, known_source(adaptive), adaptive.estimate.arc_length_m
    here = known_height(adaptive, inputs, s, ahead_m)
    if not math.isfinite(here):
        return False
    behind = known_height(adaptive, inputs, s - REGISTRATION_M, ahead_m - REGISTRATION_M)
    beyond = known_height(adaptive, inputs, s + REGISTRATION_M, ahead_m + REGISTRATION_M)
    # the first one is known; NaN is neither greater nor less
    highest, lowest = max(here, behind, beyond), min(here, behind, beyond)
    gate, bias_m = disagreement_m(adaptive), known.bias_m[source]
    agrees = lowest - gate < h_m - bias_m < highest + gate
    difference_m = min(max(h_m - here - bias_m, -gate), gate)
    known.difference_m2[source] += QUICK_RATE * (difference_m * difference_m - known.difference_m2[source])
    known.contradictions = 0 if agrees else known.contradictions + 1
    drop_length_m = 2.0 * APART_M  # a map is not used for as long after an error
    _confirm_drop(adaptive, h_m, agrees, drop_length_m)
    # at first the mean is that of all
    known.compared[source] += 1 if known.compared[source] * SLOW_RATE < 1.0 else 0
    bias_m += difference_m / known.compared[source]
    known.bias_m[source] = min(max(bias_m, -APART_M), APART_M)
    if known.contradictions < 2:
        return False
    known.descent_m = 0.0
    known.trusted_from_m = s + max(adaptive.lookahead.ahead_m, drop_length_m)
    return True


@jit
def is_useful(adaptive):
    """Whether known ground differs by little from what the sensor under the tool measures, on average.

    Each of many samples may agree and all of them differ: ground that changed a little, or much noise.
    """
    limit_m = max(0.5 * DISAGREEMENT_M, 2.0 * adaptive.noise.sigma_m)
    return adaptive.known.difference_m2[known_source(adaptive)] < limit_m * limit_m


@jit
def lowest_plan(adaptive, sensed_m):
    """Lowest setpoint of a plan beside that of the sensor under the tool [m].

    It may descend by as much as a confirmed drop where two samples can contradict it in time.
    """
    late = is_long(2.0 * adaptive.hold.interval_s, adaptive.plant.tau_s)
    return sensed_m - MAX_UNCONFIRMED_DESCENT_M - (0.0 if late else adaptive.known.descent_m)


@jit
def reset_known_ground(known):
    """Discard contradictions and confirmed drops."""
    known.contradictions = 0
    known.peak_m = known.descent_m = 0.0
