"""Plant identification: the time constant of the controlled axis.

Axis models with different time constants follow the follower's own set points. The squared errors against
the reported positions have their minimum near the true one; a parabola interpolates it. Without motion the
errors are equal, and the configured time constant stays.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.axis_model import axis_velocity
from surffollow.forecast.adaptive.shadow_axes import AXIS_STEP_NS, MAX_AXIS_GAP_NS
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import N_PERIODS, N_PLANTS
from surffollow.shm.layout_follow import POSES

TAU_RATIO = 1.5  # between neighbouring τ
MAX_MODEL_ERROR_M = 5e-4  # nor from one so far away: it is led by somebody else, or otherwise built
SUSPENSION_NS = 500_000_000  # and no plan is made for it for so long
ERROR_RATE = 0.004  # per pose report: 2.5 s at 100 Hz
MIN_DIFFERENCE_M2 = 2.5e-9  # (50 µm)²: least difference of squared errors that tells anything
RESET_ERROR_M = 3e-3  # a robot that is farther away does not obey: nothing to learn
TAU_RATE = 0.02
POSITION_GAIN = 0.3  # how far a report pulls the own axis
VELOCITY_GAIN_HZ = 2.0


@jit
def reset_axes(params: Any, a: Any, t_ns: Any, z_m: Any) -> None:
    """Put all axes where the tool is."""
    for k in range(N_PLANTS):
        a.plant_z_m[k], a.plant_v_mps[k] = z_m, a.climb_mps
    a.axis_now_m, a.axis_now_mps = z_m, a.climb_mps
    a.plant_ns = t_ns
    if a.tau_s <= 0.0 or a.tau_assumed_s != params.plant_tau_s:
        a.tau_s = a.tau_assumed_s = params.plant_tau_s
        for k in range(N_PLANTS):
            a.plant_m2[k] = 0.0


@jit
def predict_axis(params: Any, a: Any, to_ns: Any) -> Any:
    """Height and speed of the robot's axis at a later time, carried on from `plant_ns` with τ as found."""
    z, v = a.axis_now_m, a.axis_now_mps
    span = min(to_ns - a.plant_ns, MAX_AXIS_GAP_NS)
    if span <= 0:
        return z, v
    steps = max((span + AXIS_STEP_NS - 1) // AXIS_STEP_NS, 1)
    dt = span * 1e-9 / steps
    a_max = params.plant_a_max_mps2
    j = max(0, a.ticks - N_PERIODS)
    for n in range(steps):
        t = a.plant_ns + (span * n) // steps
        while j + 1 < a.ticks and a.tick_t_ns[(j + 1) & (N_PERIODS - 1)] <= t:
            j += 1
        d = a.own_m[j & (N_PERIODS - 1)] - z
        most = min(params.plant_v_max_mps, abs(d) / dt)
        w = min(max(axis_velocity(d, a.tau_s, a_max), -most), most)
        v += min(max(w - v, -a_max * dt), a_max * dt)
        z += v * dt
    return z, v


@jit
def propagate_axes(params: Any, a: Any, to_ns: Any) -> None:
    """Carry the axes on with the own set points."""
    span = to_ns - a.plant_ns
    steps = max((span + AXIS_STEP_NS - 1) // AXIS_STEP_NS, 1)
    dt = span * 1e-9 / steps
    a_max, v_max = params.plant_a_max_mps2, params.plant_v_max_mps
    dv = a_max * dt
    j = max(0, a.ticks - N_PERIODS)
    for n in range(steps):
        t = a.plant_ns + (span * n) // steps
        while j + 1 < a.ticks and a.tick_t_ns[(j + 1) & (N_PERIODS - 1)] <= t:
            j += 1
        target = a.own_m[j & (N_PERIODS - 1)]
        for k in range(N_PLANTS):
            tau = a.tau_assumed_s * TAU_RATIO ** (k - N_PLANTS // 2)
            d = target - a.plant_z_m[k]
            most = min(v_max, abs(d) / dt)
            w = min(max(axis_velocity(d, tau, a_max), -most), most)
            a.plant_v_mps[k] += min(max(w - a.plant_v_mps[k], -dv), dv)
            a.plant_z_m[k] += a.plant_v_mps[k] * dt
    a.axis_now_m, a.axis_now_mps = predict_axis(params, a, to_ns)
    a.plant_ns = to_ns


@jit
def best_time_constant(a: Any) -> Any:
    """τ of the least error, by a parabola through three; 0 when nothing is told."""
    b, worst = 0, 0.0
    for k in range(N_PLANTS):
        worst = max(worst, a.plant_m2[k])
        if a.plant_m2[k] < a.plant_m2[b]:
            b = k
    if worst - a.plant_m2[b] < MIN_DIFFERENCE_M2:
        return 0.0
    # a parabola over √τ through three: over τ it would end too high, over log τ too low
    b = min(max(b, 1), N_PLANTS - 2)
    middle = math.sqrt(a.tau_assumed_s * TAU_RATIO ** (b - N_PLANTS // 2))
    left, right = middle / math.sqrt(TAU_RATIO), middle * math.sqrt(TAU_RATIO)
    down = (a.plant_m2[b] - a.plant_m2[b - 1]) / (middle - left)
    up = (a.plant_m2[b + 1] - a.plant_m2[b]) / (right - middle)
    bend = (up - down) / (right - left)
    if bend <= 0.0:
        return middle * middle
    root = min(max(0.5 * (left + middle - down / bend), left), right)
    return root * root


@jit
def model_error(a: Any) -> Any:
    """Squared error of the axis that comes nearest to the reports [m²]."""
    least = a.plant_m2[0]
    for k in range(1, N_PLANTS):
        least = min(least, a.plant_m2[k])
    return least


@jit
def remove_common_error(a: Any) -> None:
    """Forget by how much all axes were wrong: others have led the robot since; what tells τ stays."""
    least = model_error(a)
    for k in range(N_PLANTS):
        a.plant_m2[k] -= least


@jit
def update_plant(params: Any, a: Any, sense: Any, adapt: Any) -> None:
    """Compare the axes with a new pose report and move τ toward the best."""
    newest = (sense.pose_count - 1) & (POSES - 1)
    t, z = sense.pose_t_ns[newest], sense.pose[7 * newest + 2]
    if t == a.plant_ns:
        return
    if a.set_ns == 0:
        remove_common_error(a)
    gap = t <= a.plant_ns or t - a.plant_ns > MAX_AXIS_GAP_NS
    if a.ticks == 0 or a.set_ns == 0 or a.shown != 0 or gap or a.tau_assumed_s != params.plant_tau_s:
        reset_axes(params, a, t, z)
        return
    propagate_axes(params, a, t)
    least = 1e300
    for k in range(N_PLANTS):
        least = min(least, abs(a.plant_z_m[k] - z))
    if not least < MAX_MODEL_ERROR_M:
        a.distrust_ns = max(a.distrust_ns, t + SUSPENSION_NS)
    if not least < RESET_ERROR_M:
        reset_axes(params, a, t, z)
        return
    e = z - a.axis_now_m
    a.axis_now_m += POSITION_GAIN * e
    a.axis_now_mps += VELOCITY_GAIN_HZ * e
    most = params.plant_v_max_mps
    a.axis_now_mps = min(max(a.axis_now_mps, -most), most)
    if adapt == 0 or not least < MAX_MODEL_ERROR_M:
        return
    for k in range(N_PLANTS):
        e = a.plant_z_m[k] - z
        a.plant_m2[k] += ERROR_RATE * (e * e - a.plant_m2[k])
    tau = best_time_constant(a)
    if tau > 0.0:
        a.tau_s *= math.exp(TAU_RATE * math.log(tau / a.tau_s))
