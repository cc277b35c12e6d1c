"""Model weights from a two-horizon performance index on simulated axes.

Each model drives a shadow axis (`shadow_axes`). The squared stand-off error of that axis at a sample,
averaged over a recent and a longer horizon, is the performance index. The variance of the noise is
subtracted, and penalties for effort and chance are added.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.estimation import model_bank, setpoint_lead
from surffollow.forecast.quantities import FULL_POWER_SAMPLES
from surffollow.forecast.sensing.kinematics import path_speed
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_estimation import CURVES, N_MODELS, WAVES


@jit_inlined
def blended(adaptive, values):
    """Blend of the models' values: Σ w_i x_i."""
    total = 0.0
    for i in range(N_MODELS):
        total += adaptive.weights.weight[i] * values[i]
    return total


@jit
def update_index(params, adaptive, travel_m, dt_s, target_m):
    """Update the performance index of all models with a sample, then the weights.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`weights` updated)
    travel_m : float64  distance travelled since the sample before [m]
    dt_s : float64      time since the sample before [s]
    target_m : float64  desired height of the tool over the sample [m]
    """
    weights, estimate = adaptive.weights, adaptive.estimate
    rate = travel_m / params.score_travel_m + dt_s / params.score_time_s
    samples = estimate.samples  # after an initialisation those since then count
    if weights.scored < FULL_POWER_SAMPLES:
        samples = min(samples, weights.scored)
    burn_in_rate = 1.0 / (1.0 + samples)
    f = max(1.0 - elementary.exp(-rate), burn_in_rate)
    g = max(1.0 - elementary.exp(-rate / params.long_factor), burn_in_rate)
    position_m, left_out = adaptive.shadow.position_m, adaptive.lead.left_out
    for i in range(N_MODELS):
        effect_m = position_m[i] - position_m[N_MODELS + i] if i < WAVES else 0.0
        e = position_m[i] - left_out[i] * effect_m - target_m
        weights.recent_m2[i] += f * (e * e - weights.recent_m2[i])
        weights.longer_m2[i] += g * (e * e - weights.longer_m2[i])
    setpoint_lead.update_lead(params, adaptive, f, g, target_m)
    weights.scored = min(weights.scored + 1, FULL_POWER_SAMPLES)
    weights.waiting_s += dt_s
    if weights.waiting_s >= 0.005:  # quicker sensors do not update the weights with each sample
        update_weights(params, adaptive, weights.waiting_s)


@jit
def compute_costs(params, adaptive):
    """Compute the cost of each model: its performance index and penalties.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`weights.cost` updated)

    Notes
    -----
        c_i = p_J ln(J_i − σ_J² + ε²) + p_L ln(L_i − σ_L² + ε²) + p_E ln(1 + E_i/E_0) + C_i

    S is the noise share of the least J_i, 1 up to 1.4 noise variances, α the progress of the scoring. The
    other symbols are those of docs/explanation/following.md.
    """
    shadow, weights, noise_m = adaptive.shadow, adaptive.weights, adaptive.noise.sigma_m
    least_j, least_l = weights.recent_m2.min(), weights.longer_m2.min()
    # differences below the noise are small but significant; great errors come from few places
    s = min(1.4 * noise_m * noise_m, least_j) / least_j if least_j > 0.0 else 1.0
    alpha, p_l = weights.scored / FULL_POWER_SAMPLES, params.long_power
    p_j = p_l + (params.score_power - p_l) * (s * s * alpha * alpha)
    # on rough ground the smoother of two equal models is better, and during burn-in a model that follows the
    # noise may fit by chance
    p_e = 0.8 * ((1.0 - s) * (1.0 - s)) + 6.0 * s * s * (1.0 - alpha)
    noise_j = params.noise_share * min(noise_m * noise_m, least_j)
    noise_l = params.noise_share * min(noise_m * noise_m, least_l)
    floor = params.score_floor_m * params.score_floor_m
    spacing_m = path_speed(adaptive.kinematics) * adaptive.hold.interval_s
    for i in range(N_MODELS):
        c = p_j * elementary.log(weights.recent_m2[i] - noise_j + floor)
        c += p_l * elementary.log(weights.longer_m2[i] - noise_l + floor)
        # a wave fits part of any noise for a while, a curve a smaller part
        chance = 8.0 if i >= WAVES else 1.0 if i >= CURVES else 0.0
        c += p_e * elementary.log(shadow.effort[i] + 1.0) + s * s * chance  # effort in (1 m/s²)²
        # phase of a wave between two samples: from π on it is an alias of a longer one
        is_alias = i >= WAVES and model_bank.SCALE[i] * spacing_m > 2.0 * math.pi / 3.0
        weights.cost[i] = math.inf if is_alias else c


@jit
def update_weights(params, adaptive, dt_s):
    """Compute the weights w_i ∝ exp(−c_i), filtered in time.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`weights` updated)
    dt_s : float64  time since the weights before [s]; ∞: no filter
    """
    weights = adaptive.weights
    compute_costs(params, adaptive)
    least, total = weights.cost.min(), 0.0
    for i in range(N_MODELS):
        weights.cost[i] = elementary.exp(least - weights.cost[i])
    for i in range(N_MODELS):  # sums in their order do not vectorise
        total += weights.cost[i]
    alpha = weights.scored / FULL_POWER_SAMPLES
    rate = 1.0 - elementary.exp(-dt_s / (0.02 * alpha))  # quicker while little was scored
    for i in range(N_MODELS):
        weights.weight[i] += rate / total * weights.cost[i] - rate * weights.weight[i]
    weights.waiting_s = 0.0
