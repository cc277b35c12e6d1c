"""Measurement update: the newest sample from range to estimate.

range → pose at the range's timestamp → footprint → latency, health, plane fit → innovation gate, bank
"""

from surffollow.forecast import elementary, fold_back
from surffollow.forecast.attitude import beam_detection, plane_fit, rotation_response
from surffollow.forecast.estimation import estimate
from surffollow.forecast.modes import orients
from surffollow.forecast.plant.observed_axis import height_is_known, predict_pose
from surffollow.forecast.pose import footprint, newest_pose
from surffollow.forecast.quantities import follow_usual
from surffollow.forecast.sensing import (
    constant_ranges,
    descent,
    frame_check,
    health,
    kinematics,
    response,
    standoff,
)
from surffollow.forecast.sensing.latency_identification import observe_height, update_delay
from surffollow.forecast.sensing.sample_hold import is_slow, new_sample, observe_timestamp, record_sample
from surffollow.forecast.terrain import known_ground, preview, terrain_buffer
from surffollow.shm.jit import jit, jit_inlined


@jit_inlined
def process_sample(params, adaptive, sense, fold, inputs, output, pose):
    """Process a new sample, if there is one, and decide which readings are mapped.

    A sample is that enters the estimate. Of several beams the accepted ones are, with the newest such sample
    or behind it.

    Parameters
    ----------
    params, adaptive, sense, fold, inputs, output : dimensionless records (`reference_scales`)
    pose : (7,) float64  scratch: the pose at the sample's time

    Notes
    -----
    The newest pose reported gives the desired height and the sample's place in the preview.
    """
    sample, channel = adaptive.sample, 0
    if orients(params):
        reference = adaptive.beams.reference
        if inputs.n_ranges > 0 and sense.fresh[reference] != 0:
            observe_timestamp(adaptive, sense.range_t_ns[reference])
        channel = beam_detection.observe_beams(params, adaptive, sense, pose)
    else:
        beam_detection.release_beams(adaptive.beams)
        plane_fit.reset_plane(adaptive.plane)
        rotation_response.reset_rotation(adaptive.rotation)
    if channel >= 0:
        is_new, range_m, t = new_sample(params, adaptive, sense, inputs, channel)
        if is_new:
            sample.entered = 0
            enter_sample(params, adaptive, sense, fold, inputs, output, pose, channel, range_m, t)
    if orients(params):
        for c in range(params.n_channels):
            if sample.entered == 0 or adaptive.beams.accepted[c] == 0:
                output.fresh &= ~(1 << c)


@jit_inlined
def enter_sample(params, adaptive, sense, fold, inputs, output, pose, channel, range_m, t):
    """Check a new sample and let it enter the estimate, if nothing is wrong with it.

    Parameters
    ----------
    params, adaptive, sense, fold, inputs, output, pose : as in `process_sample`
    channel : int64    the one that it is of
    range_m : float64  its range [m]
    t : int64          its timestamp
    """
    responds, t = observe_sensor(params, adaptive, sense, t, range_m, pose, fold.close != 0)
    if t <= adaptive.estimate.sample_ns or not responds or adaptive.repeats.unused != 0:
        return
    x, y, h, sensor_z = footprint(pose, params.tool_from_sensor, channel, range_m)
    if health.note_beam(adaptive.health, h >= sensor_z):
        return
    close = health.count_close(adaptive.health, range_m < params.too_close_m)
    if close or fold.close != 0:
        fold_back.watch_fold_back(params, fold, channel, range_m, sensor_z)
    # the error of heights behind a report is a copy of the tool's own motion: one sample counts per report
    if not height_is_known(adaptive, sense, t):
        if adaptive.sample.pose_count == sense.pose_count:
            return
        adaptive.sample.pose_count = sense.pose_count
    at_rest = kinematics.is_at_rest(adaptive.kinematics)
    if orients(params):
        x, y = pose[0], pose[1]
        accepted, h = plane_fit.plane_height(params, adaptive, t, pose)
        if accepted == 0:
            return
        rotation_response.observe_rotation(params, adaptive, t, pose)
    travel = advance_path(params, adaptive, t, x, y, pose)
    if not orients(params) and (at_rest or adaptive.latency.count > 0):
        observe_height(params, adaptive, sense, t, h, pose)
    standoff_m = standoff.standoff_height(params, adaptive.plane, sense)
    entered = estimate.update_estimate(params, adaptive, t, travel, h, standoff_m)
    if not at_rest:
        ahead = footprint_lead(adaptive, sense.pose, 7 * newest_pose(sense))
        if known_ground.compare_known_ground(adaptive, inputs, ahead, h):
            preview.withdraw_preview(adaptive.preview)
    if not entered:
        return
    adaptive.sample.entered = 1
    kinematics.note_accepted(adaptive.kinematics, t)
    terrain_buffer.store_ground_under(adaptive, adaptive.estimate.arc_length_m, h)
    preview.observe_ground(params, adaptive, h)
    if not orients(params):
        output.fresh |= 1
        output.target_m[0], output.target_m[1], output.target_m[2] = x, y, h


@jit_inlined
def observe_sensor(params, adaptive, sense, t_ns, range_m, pose, close):
    """Test the sensor with a sample: whether it responds, and the sample's time less the latency.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (updated), `SenseState`
    t_ns : int64         timestamp of the sample
    range_m : float64    its range [m]
    pose : (7,) float64  receives the pose at the sample's time
    close : bool         the sensor may be in its fold-back

    Returns
    -------
    bool, int64 [ns]
    """
    record_sample(adaptive.hold, t_ns, range_m)
    stamped_s = (adaptive.clock.now_ns - t_ns) * 1e-9
    if not orients(params):  # beams have timestamps of their own, without correction
        t_ns -= int(adaptive.latency.correction_s * 1e9)
    delay_s, interval_s = (adaptive.clock.now_ns - t_ns) * 1e-9, adaptive.hold.interval_s
    update_delay(adaptive.latency, delay_s, stamped_s, interval_s)
    predict_pose(params, adaptive, sense, t_ns, pose)
    was_stuck = response.is_unresponsive(adaptive.response)
    if orients(params):
        range_m = rotation_response.mean_beam_range(params, adaptive.beams, sense, t_ns, range_m)
    frame_check.observe_frame(params, adaptive, close, t_ns, range_m, pose[2])
    if kinematics.is_other_frame(adaptive.kinematics, t_ns):
        response.restart_test(adaptive.response)  # its heights are in the frame before
    if kinematics.spans_jump(adaptive.kinematics):
        constant_ranges.forget_slopes(adaptive.run)
    spread_m = descent.observe_descent(params, adaptive, t_ns, range_m, pose[2])
    response.observe_response(params, adaptive, t_ns, range_m, pose[2], spread_m)
    responds = not response.is_unresponsive(adaptive.response)
    if was_stuck and responds:
        estimate.discard_estimate(adaptive.estimate)
    return responds, t_ns


@jit_inlined
def advance_path(params, adaptive, t_ns, x_m, y_m, pose):
    """Advance the path to a footprint; returns the distance travelled since the one before [m].

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`sample` updated)
    t_ns : int64         time of the sample
    x_m, y_m : float64   its footprint [m]
    pose : (7,) float64  pose at that time
    """
    motion, sample, known = adaptive.kinematics, adaptive.sample, adaptive.estimate.samples > 0
    sample.tip_x_m = sample.tip_y_m = 0.0
    if not orients(params):
        sample.tip_x_m, sample.tip_y_m, _ = standoff.axis_ground_point(params, pose, 0)
    travel = motion.speed_mps * (t_ns - adaptive.estimate.sample_ns) * 1e-9 if known else 0.0
    # the tool of a slow sensor may have turned since the sample before
    if known and is_slow(adaptive) and not kinematics.spans_jump(motion):
        travel = elementary.hypot(x_m - sample.x_m, y_m - sample.y_m)
    follow_heading(adaptive, x_m, y_m)
    sample.x_m, sample.y_m = x_m, y_m
    if not kinematics.is_at_rest(motion):
        lead_m = footprint_lead(adaptive, pose, 0)
        sample.lead_m = follow_usual(sample.lead_m if known else 0.0, lead_m)
    return travel


@jit
def footprint_lead(adaptive, pose, at):
    """Distance of the newest footprint ahead of the point under the tool at `pose[at:]` [m]; it must move."""
    sample = adaptive.sample
    gap_x, gap_y = sample.x_m - pose[at] - sample.tip_x_m, sample.y_m - pose[at + 1] - sample.tip_y_m
    return kinematics.distance_along(adaptive.kinematics, gap_x, gap_y)


@jit
def has_turned_back(adaptive):
    """Whether the tool goes back, against the heading of the newest sample."""
    motion, sample = adaptive.kinematics, adaptive.sample
    along = motion.velocity_x_mps * sample.heading_x + motion.velocity_y_mps * sample.heading_y
    return along < -kinematics.MIN_DIRECTION_SPEED_MPS


@jit
def follow_heading(adaptive, x_m, y_m):
    """Take the heading of a sample; turn the bank by the angle between two headings.

    The heading of a slow sensor is the way between two footprints: the velocity is a mean that turns late. It
    stays when the frame has jumped in between. A quicker one learns the slope anew, unless its footprints go
    back.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    x_m, y_m : float64  the footprint; `sample` has the one before
    """
    motion, sample = adaptive.kinematics, adaptive.sample
    if kinematics.is_at_rest(motion):
        return
    way_x, way_y = x_m - sample.x_m, y_m - sample.y_m
    along = way_x * sample.heading_x + way_y * sample.heading_y
    known = adaptive.estimate.samples > 0  # a first sample has no footprint before it
    if known and is_slow(adaptive):
        way = elementary.hypot(way_x, way_y)
        least_m = kinematics.MIN_DIRECTION_SPEED_MPS * adaptive.hold.interval_s
        if way <= least_m or kinematics.spans_jump(motion):
            return
        turned = sample.heading_x != 0.0 or sample.heading_y != 0.0
        heading_x, heading_y, cosine = way_x / way, way_y / way, along / way
    else:
        turned = known and has_turned_back(adaptive)
        if turned and along >= 0.0:
            return  # the footprint is still ahead of the one before
        heading_x = motion.velocity_x_mps / motion.speed_mps
        heading_y = motion.velocity_y_mps / motion.speed_mps
        cosine = -1.0
    if turned:
        estimate.turn_estimate(adaptive, cosine)
        sample.lead_m = -sample.lead_m if cosine < 0.0 else sample.lead_m
    if sample.heading_x * heading_x + sample.heading_y * heading_y < 0.0:
        constant_ranges.turn_back(adaptive.run)
    sample.heading_x, sample.heading_y = heading_x, heading_y
