"""Ground that no range shows: how far it may have risen."""

import math

from surffollow.forecast.estimation.innovation_gate import is_slow
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN


@jit
def rise_rate(adaptive):
    """Rate at which ground that is not seen may rise: as steeply as that of the last metre [m/s]."""
    estimate = adaptive.estimate
    return max(math.sqrt(estimate.slope_power), estimate.slope) * adaptive.kinematics.speed_mps


@jit
def unseen_rise(adaptive):
    """Height by which it may have risen since the last range that is known to be right [m].

    During a test of the response all since its run began are uncertain. Under a slow sensor the
    ground changes while an answer is awaited, and a test may fail by chance.
    """
    unseen_s = (adaptive.clock.now_ns - adaptive.hold.t_ns) * 1e-9
    if adaptive.response.phase != RESPONSE_RUN and not is_slow(adaptive):
        unseen_s += adaptive.response.run_samples * adaptive.prediction.interval_s
    return rise_rate(adaptive) * unseen_s
