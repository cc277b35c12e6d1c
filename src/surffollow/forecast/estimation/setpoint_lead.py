"""Lead of the setpoints: which part of it each model leaves out.

An axis with the lag τ follows ground of a known slope when its setpoint leads by τ times the rate of the
height. Where slopes change at random, a smaller lead has the smaller error. Two shadow axes of each model
show it, one with the lead and one without it. An axis is linear but for its limits. Their errors e1 and e0
therefore give the error e when a part x of the lead is left out, and the part of the least mean square:

    e = e1 − x (e1 − e0),   x = ⟨e1 (e1 − e0)⟩ / ⟨(e1 − e0)²⟩

The means are over two horizons, and the smaller part counts. Ground that becomes predictable has its lead
again as soon as the recent horizon shows it.

Waves keep all of their lead: they are known ahead, and with less of it a wrong wave number does less harm.
"""

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_MODELS, WAVES


@jit
def update_lead(params, adaptive, recent_rate, longer_rate, target_m):
    """Update the parts that are left out with a sample.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`lead` updated)
    recent_rate, longer_rate : float64  weight of the sample in the means of a horizon
    target_m : float64  desired height of the tool over the sample [m]
    """
    lead, position_m = adaptive.lead, adaptive.shadow.position_m
    floor_m2 = params.score_floor_m * params.score_floor_m  # a lead without an effect stays
    for i in range(WAVES):
        error_m, effect_m = position_m[i] - target_m, position_m[i] - position_m[N_MODELS + i]
        lead.left_out[i] = 1.0
        for k, rate in ((i, recent_rate), (WAVES + i, longer_rate)):
            lead.excess_m2[k] += rate * (error_m * effect_m - lead.excess_m2[k])
            lead.effect_m2[k] += rate * (effect_m * effect_m - lead.effect_m2[k])
            part = lead.excess_m2[k] / (lead.effect_m2[k] + floor_m2)
            lead.left_out[i] = min(max(part, 0.0), lead.left_out[i])
