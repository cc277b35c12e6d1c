"""Lead of the setpoints: which part of it each model leaves out.

An axis with the lag τ follows ground of a known slope when its setpoint leads by τ times the rate of the
height. Where slopes change at random, a smaller lead has the smaller error. Two shadow axes of each model
show it, one with the lead and one without it. An axis is linear but for its limits. Their errors e1 and e0
therefore give the error e when a part x of the lead is left out, and the part of the least mean square:

    e = e1 − x (e1 − e0),   x = ⟨e1 (e1 − e0)⟩ / ⟨(e1 − e0)²⟩

Waves keep all of their lead: they are known ahead, and with less of it a wrong wave number does less harm.
"""

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_LEADS, N_MODELS


@jit
def update_lead(params, adaptive, rate, target_m):
    """Update the parts that are left out with a sample.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`lead` updated)
    rate : float64      weight of the sample in the means
    target_m : float64  desired height of the tool over the sample [m]
    """
    lead, position_m = adaptive.lead, adaptive.shadow.position_m
    floor_m2 = params.score_floor_m * params.score_floor_m  # a lead without an effect stays
    for i in range(N_LEADS):
        error_m, effect_m = position_m[i] - target_m, position_m[i] - position_m[N_MODELS + i]
        lead.excess_m2[i] += rate * (error_m * effect_m - lead.excess_m2[i])
        lead.effect_m2[i] += rate * (effect_m * effect_m - lead.effect_m2[i])
        lead.left_out[i] = min(max(lead.excess_m2[i] / (lead.effect_m2[i] + floor_m2), 0.0), 1.0)


@jit
def reset_lead(lead):
    """Leave nothing out."""
    for i in range(N_LEADS):
        lead.excess_m2[i] = lead.effect_m2[i] = lead.left_out[i] = 0.0
