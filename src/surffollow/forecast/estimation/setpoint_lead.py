"""Share of the lead: how far the setpoints of a model lead the axis.

An axis with the lag τ follows ground of a known slope when its setpoint leads by τ times the rate of the
height. Where slopes change at random, a part of that lead has the smaller error. Of each model two shadow axes
are simulated, one without a lead and one with all of it. But for its limits an axis is linear, so that their
errors e0 and e1 give the error e of any share φ, and the share of the least mean square:

    e = e0 − φ (e0 − e1),   φ = ⟨e0 (e0 − e1)⟩ / ⟨(e0 − e1)²⟩

Waves keep all of their lead: they are known ahead, and the share would hide that a wave number is wrong.
"""

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_LEADS, N_MODELS


@jit
def update_lead(params, adaptive, rate, target_m):
    """Update the shares with a sample.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`lead` updated)
    rate : float64      weight of the sample in the means
    target_m : float64  desired height of the tool over the sample [m]
    """
    lead, position_m = adaptive.lead, adaptive.shadow.position_m
    floor_m2 = params.score_floor_m * params.score_floor_m  # a lead without an effect has the whole share
    for i in range(N_LEADS):
        effect_m, error_m = position_m[i] - position_m[N_MODELS + i], position_m[i] - target_m
        lead.excess_m2[i] += rate * (error_m * effect_m - lead.excess_m2[i])
        lead.effect_m2[i] += rate * (effect_m * effect_m - lead.effect_m2[i])
        share = (lead.excess_m2[i] + floor_m2) / (lead.effect_m2[i] + floor_m2)
        lead.share[i] = min(max(share, 0.0), 1.0)


@jit
def reset_lead(lead):
    """Lead by all of the lag."""
    for i in range(N_LEADS):
        lead.excess_m2[i] = lead.effect_m2[i] = 0.0
    for i in range(N_MODELS):
        lead.share[i] = 1.0
