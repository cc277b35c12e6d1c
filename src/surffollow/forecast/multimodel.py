"""One cycle of the multiple-model follower: the block diagram, stage by stage.

reference → sensing → plant → estimation → terrain → set point → demand
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.estimate import estimate
from surffollow.forecast.estimation.model_bank import is_finite, reset_bank
from surffollow.forecast.estimation.noise import forget_noise
from surffollow.forecast.plant.identification import identify, reset_identification
from surffollow.forecast.plant.shadow_axes import period_is_over, record_setpoints, reset_shadows
from surffollow.forecast.scales import plain_time, set_reference
from surffollow.forecast.sense import take_poses, take_ranges
from surffollow.forecast.sensing.health import (
    assess,
    is_lost,
    note_not_finite,
    reset_health,
    watch_ranges,
    watch_readings,
)
from surffollow.forecast.sensing.kinematics import observe_motion, reset_motion
from surffollow.forecast.sensing.sample import reset_sampling, take_sample
from surffollow.forecast.setpoint.blend import blend_setpoints
from surffollow.forecast.setpoint.limits import filter_setpoint, limit_setpoint, release_setpoint
from surffollow.forecast.terrain.buffer import reset_buffer, store_height
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import SUSPECT
from surffollow.shm.layout_follow import (
    CHANNELS,
    DRYRUN,
    FROZEN,
    LIMITED,
    NO_POSE,
    NO_SENSOR,
    POSE_STALE,
    POSES,
    RUN_DRYRUN,
    RUN_FREEZE,
    RUN_NORMAL,
    SENSOR_LOST,
    TOO_CLOSE,
    VALID,
)

LOSS_TAUS, LOSS_INTERVALS = 60.0, 12.0  # loss time-out when none is set
POSE_TAUS, POSE_INTERVALS = 2.5, 10.0  # pose time-out when none is set
PROBE_SHARE = 0.01  # of the stand-off: least demand away from the surface while TOO_CLOSE


@jit
def reset_estimate(m: Any, scales: Any) -> None:
    """SFReset: begin with the next sample; what was learned of noise, plant and models stays.

    With `scales` = 1 nothing stays: the reference scales changed.
    """
    reset_bank(m, scales)
    reset_sampling(m, scales)
    reset_buffer(m)
    reset_health(m, scales)
    release_setpoint(m)
    if scales != 0:
        reset_motion(m)
        forget_noise(m)
        reset_identification(m)
        reset_shadows(m)


@jit
def loss_timeout(params: Any, m: Any) -> Any:
    """Longest extrapolation without a sample, in plain numbers."""
    if params.loss_timeout_ns >= 0:
        return params.loss_timeout_ns / m.reference.time_ns
    return max(LOSS_TAUS * m.reference.tau, LOSS_INTERVALS * m.sample.interval + m.sample.delay)


@jit
def pose_is_stale(params: Any, m: Any, age: Any) -> Any:
    """1 when the newest pose is too old, or as far in the future."""
    if params.pose_timeout_ns >= 0:
        return 1 if abs(age) > params.pose_timeout_ns / m.reference.time_ns else 0
    return 1 if abs(age) > max(POSE_TAUS * m.reference.tau, POSE_INTERVALS * m.kinematics.interval) else 0


@jit
def demand_of(params: Any, m: Any, sense: Any, inputs: Any, output: Any, setpoints: Any, pose: Any) -> Any:
    """Run the stages; returns status bits and writes the demand."""
    learn = 1 if params.adapt != 0 and params.run != RUN_FREEZE else 0
    timeout = loss_timeout(params, m)
    observe_motion(params, m, sense, inputs.t_ns)
    take_sample(params, m, sense, pose)
    watch_readings(m, 1 if math.isfinite(inputs.given_m[0]) else 0, sense.fresh[0])
    watch_ranges(m)
    identify(m, learn if params.run == RUN_NORMAL else 0)
    taken = 0
    if m.health.stuck == 0:
        taken = estimate(m, learn, timeout)
    store_height(m, taken)
    if is_finite(m) == 0:
        note_not_finite(m)
        reset_bank(m, 1)
        forget_noise(m)
    lost = is_lost(m, timeout)
    assess(m, lost)
    if taken != 0:
        output.fresh |= 1
    k, r = m.kinematics, m.reference
    status, cut = NO_SENSOR | SENSOR_LOST, 0.0
    if lost == 0:
        blend_setpoints(m, setpoints)
        filter_setpoint(m, max(params.permitted_variance_m, 0.0) / r.length_m)
        limit_setpoint(m)
        status = VALID | (NO_SENSOR if m.health.state > SUSPECT else 0)
        demand = m.setpoint.value - k.z
        cut = min(max(demand, -r.max_demand), r.max_demand)
        if cut != demand:
            status |= LIMITED
        if m.health.close != 0:
            cut = max(cut, min(PROBE_SHARE * r.standoff, r.max_demand))
        if period_is_over(m) != 0:
            own = k.z + (cut if params.run == RUN_NORMAL else 0.0)
            record_setpoints(m, setpoints, m.tuning.n_models, own)
    else:
        release_setpoint(m)
        reset_shadows(m)
    if m.health.close != 0:
        status |= TOO_CLOSE
    output.demand[2] = cut * r.length_m
    return status


@jit
def multimodel_step(
    params: Any, state: Any, multimodel: Any, inputs: Any, output: Any, setpoints: Any, pose: Any
) -> None:
    """Step the multiple-model follower once.

    Parameters
    ----------
    params : (1,) records of `Params`                  read only
    state : (1,) records of `FollowState`              sensing part updated
    multimodel : (1,) records of `MultimodelState`     updated
    inputs : (1,) records of `Inputs`                  ranges given, no conversions
    output : (1,) records of `Output`                  overwritten, `epoch` excepted
    setpoints, pose : (N_MODELS,), (7,) float64        scratch
    """
    p, s, m, i, o = params[0], state[0], multimodel[0], inputs[0], output[0]
    take_poses(s.sense, i)
    take_ranges(p, s.sense, i)
    o.t_ns, o.cycle, o.fresh = i.t_ns, s.cycle, 0
    o.delta_h_m = o.error_m = 0.0
    for j in range(6):
        o.demand[j] = 0.0
    for c in range(CHANNELS):
        o.range_m[c] = s.sense.range_m[c] if s.sense.valid[c] != 0 else math.nan
        o.range_t_ns[c] = s.sense.range_t_ns[c]
    n = s.sense.pose_count
    o.pose_t_ns = s.sense.pose_t_ns[(n - 1) & (POSES - 1)] if n > 0 else 0
    if n == 0:
        o.status = NO_POSE
    else:
        if set_reference(p, m, i.t_ns) != 0:
            reset_estimate(m, 1)
        age = plain_time(m.reference, i.t_ns) - plain_time(m.reference, o.pose_t_ns)
        if pose_is_stale(p, m, age) != 0:
            o.status = POSE_STALE
            release_setpoint(m)
        else:
            o.status = demand_of(p, m, s.sense, i, o, setpoints, pose)
    if p.run == RUN_DRYRUN:
        o.status = (o.status & ~VALID) | DRYRUN
    elif p.run == RUN_FREEZE:
        o.status = (o.status & ~VALID) | FROZEN
        for j in range(6):
            o.demand[j] = 0.0
    s.cycle += 1
    report(p, m, o)


@jit
def report(params: Any, m: Any, output: Any) -> None:
    """Publish the estimate in SI units."""
    r = m.reference
    second = 1e9 / r.time_ns if r.time_ns > 0 else 1.0
    output.height_m = m.weights.height * r.length_m
    output.slope = m.weights.slope if m.kinematics.speed > 0.0 else 0.0
    output.speed_mps = m.kinematics.speed * r.length_m * second
    output.error_m = params.offset_m - m.sample.range * r.length_m if m.sample.count > 0 else 0.0
    output.intervals = m.bank.samples
    output.health, output.reason = m.health.state, m.health.reason
    output.faults = m.health.faults
    output.sigma_m, output.noise_m = m.weights.sigma * r.length_m, m.noise.sigma * r.length_m
    scale = m.gate.scale * r.length_m
    output.roughness_m = math.sqrt(max(scale * scale - output.noise_m * output.noise_m, 0.0))
    output.late_s, output.tau_s = m.sample.delay / second, m.plant.tau / second
    output.latency_s = params.sensor_latency_ns * 1e-9
    output.permitted_variance_m = params.permitted_variance_m if params.permitted_variance_m > 0.0 else 0.0
