"""The structures of the follower's kernels: parameters, inputs, state and outputs.

`Params` and `Output` are published in the board; `Params` and `FollowState`
together are the snapshot that makes a recording replayable. Every field of
`Params` is eight bytes wide, so a parameter's number is its word index.
"""

from __future__ import annotations

from surffollow.config.stop_causes import STOP_NAMES
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.schema import F64, I64, Nested, Schema

CHANNELS = 8
CONVERSION_WINDOW = 64  # the most Sensor_Readings may ask for
POSES = 256  # history for interpolation: 256 ms at the fastest pose rate of 1 kHz
POINTS = 64  # the most EE_Readings may ask for
INTERVALS = 1024  # the interval ring; 2 * Range_Size must fit
MAX_CONVERSIONS = 64  # taken per cycle; older ones than these could not matter
MAX_PREVIEW = 128  # remembered heights per cycle
MAX_POSES = 4  # new poses taken per cycle

MODE_PAPER, MODE_ADAPTIVE = 0, 1
RUN_NORMAL, RUN_DRYRUN, RUN_FREEZE = 0, 1, 2
# answers to a pose report: not newer than the last; taken; taken from a clock that was set
REFUSED, TAKEN, CLOCK_SET = 0, 1, 2

# Output.status bits
VALID = 1 << 0  # the demand may be applied
NO_POSE = 1 << 1  # no pose was ever received
POSE_STALE = 1 << 2  # the newest pose is older than pose_timeout: zero demand
NO_SENSOR = 1 << 3  # no valid reading: the forecast extrapolates
TOO_CLOSE = 1 << 4  # near or inside the sensor's fold-back: only away from the surface
LIMITED = 1 << 5  # |demand| was cut to max_demand
DRYRUN = 1 << 6  # computed and logged, not to be applied
FROZEN = 1 << 7  # FREEZE: zero demand, adaptation stopped
SENSOR_LOST = 1 << 8  # extrapolated for too long (loss_timeout, or a stuck sensor's clearance): zero demand
STOPPED = 1 << 9  # the stop is latched: zero demand until the pose's holder resets it
STATUS_NAMES = (
    "VALID",
    "NO_POSE",
    "POSE_STALE",
    "NO_SENSOR",
    "TOO_CLOSE",
    "LIMITED",
    "DRYRUN",
    "FROZEN",
    "SENSOR_LOST",
    "STOPPED",
)

# causes of the latched stop: bits of `Params.stop_on`, `FollowState.stop` and `Output.stop`
STOP_REQUEST = 1 << 0  # a client asked for it
STOP_POSE_STALE = 1 << 1  # POSE_STALE
STOP_SENSOR_LOST = 1 << 2  # SENSOR_LOST
STOP_STUCK = 1 << 3  # adaptive: the mean range does not respond to the motion of the tool
STOP_TOO_CLOSE = 1 << 4  # TOO_CLOSE
STOP_POSE_LOST = 1 << 5  # the pose's holder died, or left its slot without giving the pose back
STOP_DRIVER = 1 << 6  # the driver reports a fault
STOP_START = 1 << 7  # the service started: the first demand waits for a reset
assert 1 << STOP_NAMES.index("start") == STOP_START
STOP_RESTART = 1 << 8  # it ended with other parameters in force than it has now
assert 1 << STOP_NAMES.index("restart") == STOP_RESTART
STOP_DESCENT = 1 << 9  # adaptive: the tool descends steeply, and the range stays too long
assert 1 << STOP_NAMES.index("descent") == STOP_DESCENT


class Params(Schema):
    """Parameters in force; names of the paper in lower case."""

    mode = I64(doc="0: paper, 1: adaptive (default follower)")
    run = I64(doc="0: normal, 1: DRYRUN, 2: FREEZE")
    offset_m = F64(unit="m", doc="desired stand-off along the beam of channel 0")
    sensor_readings = I64(
        doc="averaged into a reading (paper: 7; in process: 1); an adaptive demand takes the newest"
    )
    ee_readings = I64(doc="paper: target points in the rolling mean")
    interval_size_m = F64(unit="m", doc="paper: radius of an interval")
    range_size = I64(doc="paper: intervals in a range")
    permitted_variance_m = F64(unit="m", doc="change of the demand that is relayed")
    max_demand_m = F64(unit="m", doc="limit of the vertical demand")
    pose_timeout_ns = I64(unit="ns", doc="older poses give a zero demand")
    loss_timeout_ns = I64(unit="ns", doc="longest extrapolation without a valid reading")
    pose_interpolate = I64(doc="paper mode: 1: pose at the sample's own time; 0: the latest (paper)")
    too_close_m = F64(unit="m", doc="nearer readings count as near the fold-back")
    too_close_exit_m = F64(unit="m", doc="farther readings on the true branch end TOO_CLOSE")
    range_min_m = F64(unit="m", doc="nearest valid reading")
    range_max_m = F64(unit="m", doc="farthest valid reading")
    n_channels = I64(doc="channels in use")
    sensor_latency_ns = I64(unit="ns", doc="a conversion shows the range of that long ago")
    scale_m = F64(CHANNELS, unit="m/count", doc="calibration: range = zero + scale * counts")
    zero_m = F64(CHANNELS, unit="m", doc="calibration: range at 0 counts")
    tool_from_sensor = F64(CHANNELS * 7, unit="m, 1", doc="mounts: x y z qx qy qz qw per channel")
    plant_tau_s = F64(
        unit="s", doc="adaptive: assumed time constant of the vertical axis; a new one counts from SFReset on"
    )
    plant_v_max_mps = F64(unit="m/s", doc="adaptive: assumed speed limit of the vertical axis")
    plant_a_max_mps2 = F64(unit="m/s^2", doc="adaptive: assumed acceleration limit of the vertical axis")
    score_travel_m = F64(unit="m", doc="adaptive: arc length over which model errors are averaged")
    score_time_s = F64(unit="s", doc="adaptive: time over which model errors are averaged")
    score_power = F64(doc="adaptive: exponent of the weights over the recent horizon")
    long_power = F64(doc="adaptive: exponent of the weights over the longer horizon")
    long_factor = F64(doc="adaptive: longer horizon, as a multiple of the recent one")
    noise_share = F64(doc="adaptive: share of the noise subtracted from the model errors")
    score_floor_m = F64(unit="m", doc="adaptive: stand-off errors below this count as none")
    gate_scales = F64(doc="adaptive: width of the innovation gate, in usual innovations")
    gate_m = F64(unit="m", doc="adaptive: least width of the innovation gate")
    step_travel_m = F64(unit="m", doc="adaptive: travel after which a pending step down is confirmed")
    step_samples = I64(doc="adaptive: agreeing samples that confirm a pending step")
    max_wait_s = F64(unit="s", doc="adaptive: mean wait of a demand; at most half a report interval")
    plan_effort_s4 = F64(
        unit="s^4", doc="adaptive: weight of squared acceleration against squared error in a plan"
    )
    orient = I64(doc="adaptive: 1: with 3 or more sensors, demand rotations too")
    max_turn_rad = F64(unit="rad", doc="adaptive: limit of the rotation demanded")
    permitted_turn_rad = F64(unit="rad", doc="adaptive: deadband of the attitude setpoint")
    deadband_share = F64(doc="adaptive: share of Permitted_Variance that is the setpoint's deadband")
    adapt = I64(doc="adaptive: 1: learn; 0: weights, noise, gate, tau, lead, waves stay, from 500 samples on")
    hold_ns = I64(
        unit="ns",
        doc="adaptive: an unchanged range is new after so long, an unchanged conversion after 1.5 of it",
    )
    dropout_travel_m = F64(unit="m", doc="adaptive: travel without readings over which the slope decays")
    max_speed_mps = F64(
        unit="m/s", doc="adaptive: limit of the setpoint's speed, beside 2 plant_v_max (6 with preview)"
    )
    max_accel_mps2 = F64(
        unit="m/s^2", doc="adaptive: limit of the setpoint's acceleration, beside 20 plant_a_max (60)"
    )
    max_jerk_mps3 = F64(unit="m/s^3", doc="adaptive: limit of the setpoint's jerk")
    toward_factor = F64(
        doc="adaptive: share of both limits toward the surface, at the approach and behind a fall"
    )
    max_turn_speed_radps = F64(unit="rad/s", doc="adaptive: limit of the attitude setpoint's angular speed")
    max_turn_accel_radps2 = F64(unit="rad/s^2", doc="adaptive: limit of its angular acceleration")
    max_tilt_rad = F64(unit="rad", doc="adaptive: greatest angle of the tool's axis to the world's z axis")
    preview = I64(doc="adaptive: 1: preview control over remembered ground (in the service: its map)")
    stop_on = I64(doc="causes that latch the stop, bits of STOP_NAMES; set by the configuration alone")


class SenseState(Schema):
    """Sensor smoothing and the pose history."""

    window_m = F64(CHANNELS * CONVERSION_WINDOW, unit="m", doc="last valid conversions per channel")
    window_t_ns = I64(CHANNELS * CONVERSION_WINDOW, unit="ns")
    window_n = I64(CHANNELS, doc="valid conversions in a row since the last invalid one")
    fresh = I64(CHANNELS, doc="1: this cycle brought a valid reading")
    range_m = F64(CHANNELS, unit="m", doc="smoothed distance")
    range_t_ns = I64(CHANNELS, unit="ns", doc="middle of the averaged conversions")
    valid = I64(CHANNELS, doc="1: the newest conversion is valid; in paper mode the window is full, too")
    missed = I64(CHANNELS, doc="1: a step without a valid sample since the last one")
    seen_t_ns = I64(CHANNELS, unit="ns", doc="time of the newest valid sample; 0: none yet")
    spacing_ns = I64(
        CHANNELS, unit="ns", doc="usual time between the newest samples of two steps; 0: not known"
    )
    losses = I64(CHANNELS, doc="losses so far: invalid samples and gaps")
    outside = I64(doc="readings of channel 0 outside the window so far")
    pose_t_ns = I64(POSES, unit="ns", doc="ring of timestamps, ascending")
    pose = F64(POSES * 7, unit="m, 1", doc="ring of x y z qx qy qz qw, world from tool")
    pose_count = I64(doc="poses ever accepted")
    poses_refused = I64(doc="poses not newer than the last one")
    back_count = I64(doc="refused ones in a row whose timestamps rise among themselves")
    back_first_ns = I64(unit="ns", doc="timestamp of the first of them")
    back_newest_ns = I64(unit="ns", doc="timestamp of the newest of them")


class PaperState(Schema):
    """Intervals, ranges and forecast of the paper (§3.2)."""

    point_m = F64(CHANNELS * POINTS * 3, unit="m", doc="per channel a ring of target points")
    point_t_ns = I64(POINTS, unit="ns", doc="channel 0: timestamp of the pose that each point was made with")
    point_count = I64(CHANNELS, doc="target points of the channel since the reset or the last loss")
    point_losses = I64(CHANNELS, doc="losses of the channel when its last point came")
    mean_m = F64(3, unit="m", doc="channel 0: rolling mean of the target points")
    interval_x_m = F64(INTERVALS, unit="m", doc="ring of interval centres")
    interval_y_m = F64(INTERVALS, unit="m")
    interval_h_m = F64(INTERVALS, unit="m", doc="ring of mean heights")
    interval_n = I64(INTERVALS, doc="target points in each mean")
    interval_count = I64(doc="intervals ever opened; the newest is count-1")
    rest_h_m = F64(unit="m", doc="sum of the current range's heights without the newest")
    range_prev_h_m = F64(unit="m", doc="mean height of the range before the current one")
    range_gap_m = F64(unit="m", doc="distance along the path between the two newest ranges")
    range_cut = I64(doc="Range_Size that the ranges were cut with")
    slope = F64(unit="1", doc="Φ of the two newest ranges")
    speed_mps = F64(unit="m/s", doc="most recent lateral speed of the footprint")
    speed_x_m = F64(unit="m", doc="mean target point at the pose update before")
    speed_y_m = F64(unit="m")
    speed_t_ns = I64(unit="ns", doc="mean timestamp of the poses that it was made with")
    speed_pose = I64(doc="pose_count then; 0: none since the reset or the last loss")
    reading_t_ns = I64(unit="ns", doc="cycle time of the last valid reading; 0: none yet")
    reading_m = F64(unit="m", doc="last valid distance")
    reading_z_m = F64(unit="m", doc="sensor height at the last valid reading")
    reading_x_m = F64(unit="m", doc="the newest pose's place then")
    reading_y_m = F64(unit="m")
    before_x_m = F64(unit="m", doc="the place of the pose before that one")
    before_y_m = F64(unit="m")
    relayed = I64(doc="1: the two below are set")
    relayed_m = F64(unit="m", doc="last relayed demand")
    relayed_z_m = F64(unit="m", doc="sensor height when it was relayed")


class FoldBackState(Schema):
    """The sensor's fold-back, in every mode (`forecast.fold_back`)."""

    close = I64(doc="1: TOO_CLOSE is latched")
    channel = I64(doc="channel of the branch test")
    close_z_m = F64(unit="m", doc="tool height where the branch test began")
    close_range_m = F64(unit="m", doc="reading where the branch test began")


class Inputs(Schema):
    """All that a cycle reads from outside; what is logged."""

    t_ns = I64(unit="ns", doc="the cycle's time, CLOCK_MONOTONIC")
    n_conversions = I64()
    conversion = I64(MAX_CONVERSIONS, doc="packed, see shm.conversion")
    n_poses = I64()
    pose_t_ns = I64(MAX_POSES, unit="ns")
    pose = F64(MAX_POSES * 7, unit="m, 1")
    n_ranges = I64(doc="> 0: distances are given directly (CSV, Follower), no conversions")
    given_m = F64(CHANNELS, unit="m", doc="given distances; NaN: none")
    given_t_ns = I64(unit="ns", doc="when they were true")
    n_preview = I64(doc="remembered heights along the direction of travel; 0: none")
    preview_from_m = F64(
        unit="m", doc="where the first is, ahead of where the tool points (negative: behind)"
    )
    preview_step_m = F64(unit="m", doc="distance between them")
    preview_m = F64(MAX_PREVIEW, unit="m", doc="heights; NaN: unknown")


class Output(Schema):
    """Output of a cycle."""

    t_ns = I64(unit="ns", doc="when the demand was computed")
    pose_t_ns = I64(unit="ns", doc="timestamp of the pose that the demand adds to; 0: none")
    demand = F64(6, unit="m, rad", doc="x y z rx ry rz to add to that pose")
    status = I64(doc="bits, see STATUS_NAMES")
    cycle = I64(doc="cycle number")
    epoch = I64(doc="of the service; changes with every start")
    range_m = F64(CHANNELS, unit="m", doc="smoothed distances; NaN: none, or older than loss_timeout_ns")
    range_t_ns = I64(CHANNELS, unit="ns")
    fresh = I64(doc="bit per channel: a new valid reading in this cycle")
    target_m = F64(CHANNELS * 3, unit="m", doc="target points in the world, as mapped (fresh ones)")
    height_m = F64(unit="m", doc="surface height; paper: of the current interval")
    slope = F64(unit="1", doc="along the path")
    speed_mps = F64(unit="m/s", doc="lateral speed of the tool; paper: of the footprint")
    delta_h_m = F64(unit="m", doc="forecast change of height")
    error_m = F64(unit="m", doc="desired minus actual stand-off")
    intervals = I64(doc="paper: intervals opened since the reset; adaptive: samples in the estimate")
    health = I64(doc="adaptive: state of the ranging, see HEALTH_NAMES")
    faults = I64(doc="adaptive: latched fault bits")
    sigma_m = F64(unit="m", doc="adaptive: uncertainty of the height")
    noise_m = F64(unit="m", doc="adaptive: noise of the readings")
    roughness_m = F64(unit="m", doc="adaptive: what the models do not foresee, noise taken off")
    late_s = F64(unit="s", doc="adaptive: how late readings arrive")
    latency_s = F64(unit="s", doc="adaptive: age of a range when it is read, as calibrated")
    permitted_variance_m = F64(unit="m", doc="adaptive: hysteresis in force, Permitted_Variance as adapted")
    interval_size_m = F64(unit="m", doc="adaptive: Interval_Size as adapted")
    range_size = I64(doc="adaptive: Range_Size as adapted")
    tau_s = F64(unit="s", doc="adaptive: time constant of the robot's axis as found")
    normal = F64(3, unit="1", doc="adaptive, 3 or more sensors: unit normal of the surface")
    beams = I64(doc="adaptive, 3 or more sensors: bit per channel that agrees with the plane")
    stop = I64(doc="causes of the latched stop, bits of STOP_NAMES; 0: not stopped")
    stop_now = I64(doc="causes that this cycle saw, whether the configuration names them or not")
    reason = I64(
        doc="why `health` is not OK, or the range is tested: number of REASON_NAMES, from bit 8 channels"
    )


class ScaledState(Schema):
    """Reference scales of the default follower, and its dimensionless records (`reference_scales`).

    Dimensionless lengths are metres over `length`, dimensionless times nanoseconds over `time`; the units of
    the nested records are those of scale 1. The records are used only when one of the scales is not 1.
    """

    length = F64(doc="reference length as a multiple of the usual one, a power of two; 0: not chosen")
    time = F64(doc="reference time likewise")
    shift = I64(doc="its binary logarithm")
    epoch_ns = I64(unit="ns", doc="epoch of dimensionless times; 0: not chosen, or times are as they are")
    params = Nested(Params)
    sense = Nested(SenseState)
    fold = Nested(FoldBackState)
    inputs = Nested(Inputs)
    output = Nested(Output)


class FollowState(Schema):
    """All that a cycle remembers for the next one."""

    cycle = I64(doc="cycles stepped")
    mode = I64(doc="mode of the cycle before")
    stop = I64(doc="causes of the latched stop, bits of STOP_NAMES; 0: not stopped")
    stop_armed = I64(doc="1: a demand was valid since the last reset, so that its loss is one")
    sense = Nested(SenseState)
    paper = Nested(PaperState)
    fold = Nested(FoldBackState)
    adaptive = Nested(AdaptiveState)
    scaled = Nested(ScaledState)
