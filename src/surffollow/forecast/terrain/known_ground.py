"""Known ground against the sensor under the tool: contradictions and confirmed drops.

Known ground is what a map, the terrain memory or a look-ahead sensor gave before the tool was there. Where it
lies below what channel 0 measures, preview pulls the tool toward the surface.
"""

from surffollow.shm.jit import jit

DISAGREEMENT_M = 1.5e-3  # heights of one place that differ by more disagree
# channel 0 above the known ground by that …
CONTRADICTION_SIGMAS = 6.0  # … or by so many standard deviations of a reading …
CONTRADICTION_SAMPLES = 2  # … so often in a row: the known ground is wrong
REGISTRATION_M = 2e-3  # error of the place of a known height
DROP_LENGTH_M = 0.01  # length of a drop, and of the ground beyond that confirms it
MAX_UNCONFIRMED_DESCENT_M = 3e-3  # of a plan below the setpoint of the sensor under the tool


@jit
def compare_known_ground(adaptive, height_behind_m, height_here_m, height_ahead_m, h_m):
    """Compare channel 0's height with known ground; whether several samples in a row contradict it.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    height_behind_m, height_here_m, height_ahead_m : known heights `REGISTRATION_M` behind, at and ahead
        of the place, without bias [m]; NaN: not known
    h_m : float64            channel 0's height [m]
    """
    known = adaptive.known
    # the first one is known; NaN is neither greater nor less
    highest = max(height_here_m, height_behind_m, height_ahead_m)
    lowest = min(height_here_m, height_behind_m, height_ahead_m)
    gate = max(DISAGREEMENT_M, CONTRADICTION_SIGMAS * adaptive.noise.sigma_m)
    spacing = adaptive.sample.spacing_m
    fading = min(spacing / DROP_LENGTH_M, 1.0) if known.samples > 0 else 1.0
    known.peak_m = max(known.peak_m + (h_m - known.peak_m) * fading, h_m)
    known.samples += 1
    known.contradictions = known.contradictions + 1 if h_m > highest + gate else 0
    if known.contradictions >= CONTRADICTION_SAMPLES:
        known.descent_m = 0.0
        return True
    drop = known.peak_m - h_m
    if lowest - gate < h_m < highest + gate and drop > MAX_UNCONFIRMED_DESCENT_M:
        known.descent_m += fading * max(drop - known.descent_m, 0.0)
    return False


@jit
def lowest_plan(known, sensed_m):
    """Lowest setpoint of a plan beside that of the sensor under the tool [m]."""
    return sensed_m - MAX_UNCONFIRMED_DESCENT_M - known.descent_m


@jit
def reset_known_ground(known):
    """Discard contradictions and confirmed drops."""
    known.samples = known.contradictions = 0
    known.peak_m = known.descent_m = 0.0
