"""Look-ahead sensors: channels beyond the first that measure the ground ahead of the tool.

Their heights enter the terrain buffer; a sample that disagrees with the one before is left out. None enters
while channel 0 leads itself: nothing under the tool would check them.
"""

from surffollow.forecast.modes import orients
from surffollow.forecast.plant.observed_axis import predict_pose
from surffollow.forecast.pose import footprint
from surffollow.forecast.quantities import APART_M, LONG_GAP_NS, PLAUSIBLE_SLOPE
from surffollow.forecast.sensing.kinematics import distance_along, is_at_rest
from surffollow.forecast.terrain.known_ground import disagreement_m
from surffollow.forecast.terrain.terrain_buffer import CELL_M, sensor_leads, store_ground
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import BUFFER_CELLS


@jit
def observe_lookahead(params, adaptive, sense, pose):
    """Store the ground that channels 1 and up measure ahead of channel 0's footprint.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    pose : (7,) float64      scratch
    """
    clock, kinematics, sample = adaptive.clock, adaptive.kinematics, adaptive.sample
    estimate, lookahead = adaptive.estimate, adaptive.lookahead
    # no channel leads at rest, nor do several that give a plane, or one that was silent for long
    none = orients(params) or is_at_rest(kinematics)
    if none or clock.now_ns - lookahead.seen_ns > LONG_GAP_NS:
        lookahead.ahead_m = 0.0
    if none or estimate.samples == 0 or sensor_leads(adaptive):
        return
    for c in range(1, params.n_channels):
        t = sense.range_t_ns[c] + adaptive.hold.shift_ns
        if sense.fresh[c] == 0 or t < lookahead.range_ns[c] + params.hold_ns:
            continue
        since_ns = t - lookahead.range_ns[c]
        travel_m = kinematics.speed_mps * since_ns * 1e-9
        lookahead.range_ns[c] = t
        t -= int(adaptive.latency.correction_s * 1e9)
        predict_pose(params, adaptive, sense, t, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, sense.range_m[c])
        dx, dy = x - sample.x_m, y - sample.y_m
        along = distance_along(kinematics, dx, dy)
        across = (dx * kinematics.velocity_y_mps - dy * kinematics.velocity_x_mps) / kinematics.speed_mps
        tolerance_m = disagreement_m(adaptive) + PLAUSIBLE_SLOPE * travel_m
        # behind a rest or a start nothing is known that it could agree with
        agrees = since_ns < LONG_GAP_NS and abs(z - lookahead.height_m[c]) < tolerance_m
        lookahead.height_m[c] = z
        leads = APART_M < along < (BUFFER_CELLS - 1) * CELL_M and abs(across) < APART_M
        if agrees and leads:
            store_ground(adaptive, estimate.arc_length_m + along, z)
            lookahead.ahead_m, lookahead.seen_ns = along, clock.now_ns
