"""Look-ahead sensors: channels beyond the first that measure the ground ahead of the tool.

Their heights enter the terrain buffer; a sample that disagrees with the one before is left out. The
difference to channel 0 is estimated where channel 0 passes.
"""

import math

from surffollow.forecast.pose import footprint
from surffollow.forecast.sensing.kinematics import distance_along, predict_pose
from surffollow.forecast.terrain.known_ground import DISAGREEMENT_M, REGISTRATION_M, compare_known_ground
from surffollow.forecast.terrain.terrain_buffer import MIN_LEAD_M, buffered_height, store_ground_at
from surffollow.shm.jit import jit

BIAS_RATE = 0.02  # of the bias, per sample
MAX_BIAS_M = 5e-3  # greater differences are not a bias
MAX_LEAD_M = 0.4  # length of the terrain buffer, with a margin
TIMEOUT_NS = 200_000_000  # a sensor without samples for so long does not lead


@jit
def observe_lookahead(params, adaptive, sense, moving, pose):
    """Store the ground that channels 1 and up measure ahead of channel 0's footprint.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    moving : bool            the direction of travel is known; otherwise no channel leads
    pose : (7,) float64      scratch
    """
    clock, kinematics, sample = adaptive.clock, adaptive.kinematics, adaptive.sample
    estimate, lookahead = adaptive.estimate, adaptive.lookahead
    if not moving or clock.now_ns - lookahead.seen_ns > TIMEOUT_NS:
        lookahead.lead_m = 0.0
    if not moving or estimate.samples == 0:
        return
    for c in range(1, params.n_channels):
        t = sense.range_t_ns[c] + adaptive.hold.shift_ns
        if sense.fresh[c] == 0 or t < lookahead.range_ns[c] + params.hold_ns:
            continue
        lookahead.range_ns[c] = t
        t -= int(adaptive.latency.correction_s * 1e9)
        predict_pose(kinematics, sense, t, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, sense.range_m[c])
        dx, dy = x - sample.x_m, y - sample.y_m
        along = distance_along(kinematics, dx, dy)
        across = (dx * kinematics.velocity_y_mps - dy * kinematics.velocity_x_mps) / kinematics.speed_mps
        agrees = abs(z - lookahead.height_m[c]) < DISAGREEMENT_M
        lookahead.height_m[c] = z
        if not agrees or not MIN_LEAD_M < along < MAX_LEAD_M or abs(across) > MIN_LEAD_M:
            continue
        store_ground_at(adaptive, estimate.arc_length_m + along, z, x, y)
        lookahead.lead_m = along
        lookahead.seen_ns = clock.now_ns


@jit
def compare_lookahead(adaptive, s_m, h_m):
    """Compare buffered ground with channel 0's height there and update the bias; whether it is too low.

    Buffered ground that lies below channel 0's pulls the tool toward the surface. Several such samples in a
    row discard all that was measured ahead: it is used again beyond the newest of it.
    """
    lookahead = adaptive.lookahead
    if lookahead.lead_m == 0.0:
        return False
    buffered = buffered_height(adaptive, s_m)
    if not math.isfinite(buffered):
        return False
    height_behind_m = buffered_height(adaptive, s_m - REGISTRATION_M)
    height_ahead_m = buffered_height(adaptive, s_m + REGISTRATION_M)
    wrong = compare_known_ground(adaptive, height_behind_m, buffered, height_ahead_m, h_m - lookahead.bias_m)
    e = min(max(h_m - buffered, -MAX_BIAS_M), MAX_BIAS_M)
    lookahead.bias_m += BIAS_RATE * (e - lookahead.bias_m)
    if wrong:
        lookahead.trusted_from_m = s_m + lookahead.lead_m
    return wrong
