"""Look-ahead sensors: channels beyond the first that measure the ground ahead of the tool.

Their heights enter the terrain buffer; a sample that disagrees with the one before is left out. The
difference to channel 0 is estimated where channel 0 passes.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.kinematics import predict_pose
from surffollow.forecast.adaptive.terrain_buffer import MIN_LEAD_M, buffered_height, store_ground_at
from surffollow.forecast.pose import footprint
from surffollow.shm.jit import jit

AGREEMENT_M = 1.5e-3  # heights of two samples in a row that confirm each other
BIAS_RATE = 0.02
MAX_BIAS_M = 5e-3
MAX_LEAD_M = 0.4  # of the ring of ground
TIMEOUT_NS = 200_000_000  # a scout silent for so long no longer leads


@jit
def observe_lookahead(params: Any, a: Any, sense: Any, moving: Any, pose: Any) -> None:
    """Note the ground that channels 1 and up see ahead of channel 0's footprint.

    Parameters
    ----------
    params, a, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    moving : int             1: fast enough for a direction; at rest none of them leads
    pose : (7,) float64 scratch
    """
    if moving == 0 or a.now_ns - a.scouted_ns > TIMEOUT_NS:
        a.scout_lead_m = 0.0
    if moving == 0 or a.samples == 0:
        return
    for c in range(1, params.n_channels):
        t = sense.range_t_ns[c]
        if sense.fresh[c] == 0 or t < a.scout_ns[c] + params.hold_ns:
            continue
        a.scout_ns[c] = t
        t -= int(a.older_s * 1e9)
        predict_pose(a, sense, t, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, sense.range_m[c])
        along = ((x - a.foot_x_m) * a.speed_x_mps + (y - a.foot_y_m) * a.speed_y_mps) / a.speed_mps
        aside = ((x - a.foot_x_m) * a.speed_y_mps - (y - a.foot_y_m) * a.speed_x_mps) / a.speed_mps
        agrees = abs(z - a.scout_h_m[c]) < AGREEMENT_M
        a.scout_h_m[c] = z
        if not agrees or not MIN_LEAD_M < along < MAX_LEAD_M or abs(aside) > MIN_LEAD_M:
            continue
        store_ground_at(a, a.path_m + along, z, x, y)
        a.scout_lead_m = along
        a.scouted_ns = a.now_ns


@jit
def compare_lookahead(a: Any, s_m: Any, h_m: Any) -> None:
    """Compare what was seen ahead with what channel 0 sees there now; learn the difference."""
    if a.scout_lead_m == 0.0:
        return
    seen = buffered_height(a, s_m)
    if math.isfinite(seen):
        e = min(max(h_m - seen, -MAX_BIAS_M), MAX_BIAS_M)
        a.scout_bias_m += BIAS_RATE * (e - a.scout_bias_m)
