"""One cycle of following: `follow_step`, the same for the daemon, the replay and embedders."""

import math

from surffollow.forecast import adaptive_step, fold_back, reference_scales, reset, stop
from surffollow.forecast.modes import orients
from surffollow.forecast.paper import extrapolation
from surffollow.forecast.pose import footprint, newest_pose, pose_at
from surffollow.forecast.readings import is_absent, take_conversions, take_poses, take_ranges
from surffollow.forecast.sensing import latency_identification, sample_hold
from surffollow.shm import layout_follow as layout
from surffollow.shm.jit import jit, jit_inlined, jit_uncounted
from surffollow.shm.layout_adaptive import DROPOUT, REASON_POSE

# inlined is what runs per channel or conversion: numba hands an array over as seven words, which costs more
# than the arithmetic (tools/bench_cycle.py)


@jit
def sf_reset(params, state, offset_m):
    """SFReset: clear intervals, ranges and the previous demand, set the desired stand-off (§3.2.5).

    The pose history and the sensor windows are measurements, not forecast: they stay. So does
    the fold-back latch, which is safety.
    """
    params[0].offset_m = offset_m
    reference_scales.choose_scales(params, state)
    reset.reset_surface(state)
    state[0].stop_armed = 0


@jit
def reset_stop(params, state):
    """Leave the latched stop; the forecast restarts, as by SFReset with the stand-off in force.

    What was planned before the stop says nothing about where the tool stands now.
    """
    state[0].stop = 0
    sf_reset(params, state, params[0].offset_m)


@jit_inlined
def find_targets(params, state, output, pose):
    """Target points of fresh readings into `output.target_m`; the sensor height of channel 0 [m].

    The mean over `ee_readings` points replaces each footprint (§3.2.1), see `average_point`. The adaptive
    mode maps those samples of channel 0 that enter its estimate, unless several sensors rotate the tool.

    Parameters
    ----------
    params, state, output : records of `Params`, `FollowState` (updated), `Output` (updated)
    pose : (7,) float64 scratch
    """
    sense, adaptive = state.sense, params.mode == layout.MODE_ADAPTIVE
    interpolate = adaptive or params.pose_interpolate != 0  # pose at the time of a reading, not the latest
    first = 1 if adaptive and not orients(params) else 0
    state.paper.point_count[:first] = 0
    fresh, sensor_z = 0, 0.0
    oldest_ns = sense.pose_t_ns[max(0, sense.pose_count - layout.POSES) & (layout.POSES - 1)]
    newest_ns = sense.pose_t_ns[newest_pose(sense)]
    for c in range(first, params.n_channels):
        if sense.fresh[c] == 0:
            continue
        t_ns = sense.range_t_ns[c] if interpolate else newest_ns
        pose_at(sense, t_ns, pose)
        pose_t_ns = min(max(t_ns, oldest_ns), newest_ns)
        x, y, z, height = footprint(pose, params.tool_from_sensor, c, sense.range_m[c])
        sensor_z = height if c == 0 else sensor_z
        target = output.target_m[3 * c : 3 * c + 3]
        target[0], target[1], target[2] = x, y, z
        extrapolation.average_point(params, state.paper, sense, c, pose_t_ns, target)
        fresh |= 1 << c
    output.fresh = fresh
    return sensor_z


@jit_inlined
def clear_output(params, state, inputs, output):
    """Output of a cycle without a demand; distances are published as long as they are extrapolated.

    A reading that is not renewed stays valid until `loss_timeout_ns`.
    """
    sense = state.sense
    output.t_ns, output.cycle, output.fresh = inputs.t_ns, state.cycle, 0
    output.demand[:] = 0.0
    output.delta_h_m = output.error_m = 0.0
    for c in range(layout.CHANNELS):
        age_ns = inputs.t_ns - params.sensor_latency_ns - sense.range_t_ns[c]
        current = sense.valid[c] != 0 and (sense.fresh[c] != 0 or age_ns <= params.loss_timeout_ns)
        output.range_m[c] = sense.range_m[c] if current else math.nan
        output.range_t_ns[c] = sense.range_t_ns[c]


@jit_inlined
def demand_z(params, state, inputs, output, reading_z_m, pose):
    """The paper's vertical demand with limits, hysteresis and fold-back; returns status bits.

    Parameters
    ----------
    params, state, inputs, output : records of `Params`, `FollowState` (updated), `Inputs`, `Output` (updated)
    reading_z_m : float64  height of the sensor in the pose of a fresh reading [m]
    pose : (7,) float64    scratch
    """
    p, t_ns, fresh = state.paper, inputs.t_ns, output.fresh & 1
    sensor_z_m, farthest_m = reading_z_m, math.inf
    if fresh != 0:
        extrapolation.paper_update(params, p, state.sense)
        fold_back.watch_fold_back(params, state.fold, 0, state.sense.range_m[0], reading_z_m)
    else:
        farthest_m = extrapolation.distance_since_reading(params, p, state.sense, t_ns)
    if fresh == 0 or params.pose_interpolate != 0:
        pose_at(state.sense, output.pose_t_ns, pose)
        _, _, _, sensor_z_m = footprint(pose, params.tool_from_sensor, 0, 0.0)
    output.delta_h_m, output.error_m = extrapolation.paper_forecast(
        params, p, state.sense, t_ns, fresh, reading_z_m, sensor_z_m, farthest_m
    )
    status = layout.VALID
    if fresh == 0 and (state.sense.valid[0] == 0 or is_absent(params, t_ns - p.reading_t_ns)):
        status |= layout.NO_SENSOR
    demand_m = output.delta_h_m + output.error_m
    limited_m = fold_back.limit(demand_m, params.max_demand_m)
    if limited_m != demand_m:
        status |= layout.LIMITED
    # once more: hysteresis keeps what was relayed, up to Permitted_Variance beyond the limit
    dz = extrapolation.relay(p, limited_m, sensor_z_m, params.permitted_variance_m)
    dz = fold_back.limit(dz, params.max_demand_m)
    lost = p.reading_t_ns == 0 or t_ns - p.reading_t_ns > params.loss_timeout_ns
    if lost:
        status = (status & ~(layout.VALID | layout.LIMITED)) | layout.SENSOR_LOST
        dz = 0.0
    if state.fold.close != 0:
        status |= layout.TOO_CLOSE
        dz = 0.0 if lost else fold_back.demand_away(params, dz)
    output.demand[2] = dz
    return status


@jit_uncounted
def adaptive_cycle(params, state, sense, fold, inputs, output, pose, ready):
    """Demand, if a pose is `ready`, and report of the adaptive mode in dimensionless numbers.

    Parameters
    ----------
    params, sense, fold, inputs, output : dimensionless records (`reference_scales`)
    state : (1,) record of `FollowState`
    pose : (7,) float64 scratch
    ready : bool             there is a pose that is not stale

    Returns
    -------
    int
        Status bits.
    """
    adaptive, status = state[0].adaptive, 0
    if latency_identification.check_configured_latency(params, adaptive.latency):
        sample_hold.reset_hold(adaptive.hold)
    if ready:
        applies = params.run != layout.RUN_FREEZE and state[0].stop == 0
        status = adaptive_step.compute_demand(params, adaptive, sense, fold, inputs, output, pose, applies)
    if adaptive.health.restart != 0:
        output.fresh = 0  # of this cycle nothing is mapped
        reset.reset_follower(state, adaptive.health.restart)
    adaptive_step.publish_estimate(params, adaptive, output)
    if not ready:
        output.health, output.reason = DROPOUT, REASON_POSE
    return status


@jit_inlined
def scaled_adaptive_cycle(params, state, inputs, output, pose, ready):
    """`adaptive_cycle` behind the reference scales; where these are 1 nothing is copied.

    The arguments before `pose` are (1,) records in SI units; `ready` and the status bits as there.
    """
    s = state[0]
    d = s.scaled
    if d.length == 0.0:
        reference_scales.choose_scales(params, state)
    if reference_scales.is_unscaled(d):
        return adaptive_cycle(params[0], state, s.sense, s.fold, inputs[0], output[0], pose, ready)
    reference_scales.scale_inputs(params, state, inputs, output)
    status = adaptive_cycle(d.params, state, d.sense, d.fold, d.inputs, d.output, pose, ready)
    reference_scales.unscale_outputs(state, output)
    return status


@jit_uncounted
def follow_step(params, state, inputs, output, scratch):
    """One cycle: readings, footprints, demand of the mode in force, run mode, stop.

    Parameters
    ----------
    params : (1,) records of `Params`        read only
    state : (1,) records of `FollowState`    updated
    inputs : (1,) records of `Inputs`        poses, conversions or ranges, and preview of this cycle
    output : (1,) records of `Output`        overwritten, `epoch` excepted
    scratch : (7,) float64                   a pose

    Notes
    -----
    No clock, allocation or exception; the same inputs give the same bits. Paper §3.3.3.
    """
    p, s, i, o = params[0], state[0], inputs[0], output[0]
    if p.mode != s.mode:  # the mode in force knows the surface from before it was left
        s.mode = p.mode
        reset.reset_surface(state)
    take_poses(s.sense, i)
    if i.n_ranges > 0:
        take_ranges(p, s.sense, i)
    else:
        take_conversions(p, s.sense, i)
    clear_output(p, s, i, o)
    ready = False
    if s.sense.pose_count == 0:
        o.pose_t_ns, o.status = 0, layout.NO_POSE
    else:
        o.pose_t_ns = s.sense.pose_t_ns[newest_pose(s.sense)]
        # a pose from a future as far away says as little about now as an old one
        if abs(i.t_ns - o.pose_t_ns) > p.pose_timeout_ns:
            o.status = layout.POSE_STALE
            for c in range(layout.CHANNELS):
                s.sense.losses[c] += 1  # readings without a pose are as good as lost
        else:
            sensor_z, ready = find_targets(p, s, o, scratch), True
            o.status = 0 if p.mode == layout.MODE_ADAPTIVE else demand_z(p, s, i, o, sensor_z, scratch)
    if p.mode == layout.MODE_ADAPTIVE:
        o.status |= scaled_adaptive_cycle(params, state, inputs, output, scratch, ready)
    else:
        report_paper(s.paper, o)
    if p.run == layout.RUN_DRYRUN:
        o.status = (o.status & ~layout.VALID) | layout.DRYRUN
    elif p.run == layout.RUN_FREEZE:
        o.status = (o.status & ~layout.VALID) | layout.FROZEN
        o.demand[:] = 0.0
    s.cycle += 1
    stop.apply_stop(p, s, o)


@jit_inlined
def report_paper(paper, output):
    """Copy the state of the paper mode to the output."""
    output.slope, output.speed_mps, output.reason = paper.slope, paper.speed_mps, 0
    output.intervals = paper.interval_count
    if paper.interval_count > 0:
        output.height_m = paper.interval_h_m[(paper.interval_count - 1) & (layout.INTERVALS - 1)]
