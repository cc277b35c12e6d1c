"""State of the default follower's sensing: one record per stage (`layout_adaptive`)."""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, Schema

BEAMS = 8


class Clock(Schema):
    """Time of the follower (`clock`)."""

    now_ns = I64(unit="ns", doc="latest timestamp of steps and poses")


# of the newest jump of the reported position: a sample from behind it was accepted, or none was since a jump
# of x and y, or of the height
JUMP_SEEN, JUMP_ASIDE, JUMP_UP = range(3)


class Kinematics(Schema):
    """Velocity of the tool (`kinematics`)."""

    velocity_x_mps = F64(unit="m/s", doc="lateral velocity; 0 at rest")
    velocity_y_mps = F64(unit="m/s")
    speed_mps = F64(unit="m/s", doc="lateral speed")
    climb_mps = F64(unit="m/s", doc="vertical velocity")
    reports = I64(doc="pose reports that entered so far")
    jump_ns = I64(unit="ns", doc="timestamp of the first report after a jump of the position; 0: none")
    jump = I64(doc="JUMP_SEEN, or the jump behind which no sample was accepted: JUMP_ASIDE, JUMP_UP")
    climb_scatter_m = F64(unit="m", doc="usual distance of a reported height from where the climb rate leads")
    noise_m = F64(unit="m", doc="the same aside, but from 0: noise of the position")


class Hold(Schema):
    """Sample hold of the channel in use (`sample_hold`)."""

    t_ns = I64(unit="ns", doc="timestamp of the newest sample; 0: none yet")
    range_m = F64(unit="m", doc="its range: a conversion that repeats it is no new sample")
    interval_s = F64(unit="s", doc="usual interval of samples; 0: not known")
    readings = I64(doc="ranges averaged into a sample: of given ranges only")
    changes = I64(doc="samples with another range than the one before")
    least_m = F64(unit="m", doc="least change, which grows slowly: the count of a coarse sensor")
    backward = I64(doc="samples in a row with timestamps before that of the newest sample")
    shift_ns = I64(unit="ns", doc="correction of timestamps that went back")


class Latency(Schema):
    """Delay of samples, and the identified error of the configured latency (`latency_identification`)."""

    known = I64(doc="delays that are known, at most those of a slow mean")
    delay_s = F64(unit="s", doc="usual delay: arrival − timestamp")
    least_s = F64(unit="s", doc="least delay, which grows slowly")
    mean_s = F64(unit="s", doc="slow mean of the delay by the timestamps, without correction")
    first_s = F64(unit="s", doc="least of these means: the delay before a clock fell behind")
    correction_s = F64(unit="s", doc="age of ranges beyond the configured latency, as identified")
    configured_ns = I64(unit="ns", doc="sensor_latency_ns that the correction belongs to")
    hold_ns = I64(unit="ns", doc="hold_ns that the delays belong to")
    count = I64(doc="samples of the present rest")
    far = I64(doc="samples in a row that are far from its mean height")
    mean_climb_mps = F64(unit="m/s", doc="mean climb rate over the rest")
    mean_height_m = F64(unit="m", doc="mean height over the rest")
    climb_climb = F64(unit="m^2/s^2", doc="sum of squared deviations of the climb rate")
    climb_height = F64(unit="m^2/s", doc="sum of products of both deviations")
    height_height = F64(unit="m^2", doc="sum of squared deviations of the height")
    step_step = F64(unit="m^2", doc="sum of squared steps from one height to the next")
    newest_m = F64(unit="m", doc="newest of these heights")


class Sample(Schema):
    """Footprint of the newest sample (`measurement`)."""

    tip_x_m = F64(unit="m", doc="from the tool to the ground point on its axis")
    tip_y_m = F64(unit="m")
    lead_m = F64(unit="m", doc="distance of the footprint ahead of that point")
    x_m = F64(unit="m", doc="footprint")
    y_m = F64(unit="m")
    heading_x = F64(unit="1", doc="unit vector of the way, by velocity; slow sensors: by footprints; 0: none")
    heading_y = F64(unit="1")
    pose_count = I64(
        doc="number of the report behind which a sample was used though heights between reports are unknown"
    )
    entered = I64(doc="1: the newest sample entered the estimate")


class Health(Schema):
    """Health of the ranging (`health`)."""

    state = I64(doc="see HEALTH_NAMES")
    reason = I64(doc="why it is so: number of REASON_NAMES, from bit 8 on a bit per channel")
    since_ns = I64(unit="ns", doc="since when the candidate differs from the state")
    candidate = I64(doc="state without hysteresis")
    faults = I64(doc="bits of FAULT_NAMES, latched until the reset")
    restart = I64(doc="fault for which the follower begins without knowledge behind this cycle; 0: none")
    unseen = I64(doc="1: in silence, or under a stuck sensor, the ground may have come near unseen")
    outside_seen = I64(doc="readings of channel 0 outside the window up to the cycle before")
    outside = I64(doc="cycles with such readings since the last one inside it")
    close_count = I64(doc="samples in a row nearer than too_close_m")
    upward = I64(doc="1: the beam of the newest sample does not point downward")
    reading_ns = I64(BEAMS, unit="ns", doc="arrival of the newest reading per channel; 0: none yet")
    interval_s = F64(BEAMS, unit="s", doc="usual interval of these; 0: not known")
    used_ns = I64(BEAMS, unit="ns", doc="when each beam of a plane was last used, or has begun")


RESPONSE_RUN, RESPONSE_HOLD, RESPONSE_LIFT, RESPONSE_FAILED = range(4)


NO_SIGN, SIGN_FOR_SHIFT, SIGN_FOR_HOLD = range(3)  # of a fault, in a run of constant ranges


FRAME_UNKNOWN, FRAME_HELD, FRAME_LIFTED, FRAME_LOWERED, FRAME_RIGHT, FRAME_REVERSED = range(6)


class Frame(Schema):
    """Check whether the range grows when the tool rises (`frame_check`)."""

    phase = I64(doc="FRAME_UNKNOWN, held, lifted, lowered, FRAME_RIGHT or FRAME_REVERSED")
    begun_ns = I64(unit="ns", doc="first sample of the phase; 0: none")
    setpoint_m = F64(unit="m", doc="setpoint while the tool is held, lifted or lowered")
    least_m = F64(3, unit="m", doc="least height z of the tool, range minus z, range plus z in the phase")
    most_m = F64(3, unit="m", doc="greatest of these")


class ConstantRanges(Schema):
    """Run of constant ranges under a tool that moves (`constant_ranges`)."""

    mean_m = F64(unit="m", doc="running mean of the range")
    error_m = F64(unit="m", doc="usual distance of the mean from the stand-off, outside tests")
    spread_m = F64(unit="m", doc="mean deviation of the ranges from it")
    usual_m = F64(unit="m", doc="the usual one")
    range_m = F64(unit="m", doc="mean range of the run of constant ranges")
    samples = I64(doc="samples since its begin")
    band_m = F64(unit="m", doc="change of the mean range that noise explained then")
    offset_m = F64(unit="m", doc="stand-off then")
    slope = F64(doc="slope of the ground then")
    lasting_slope = F64(doc="its mean over the time before")
    mean_slope = F64(doc="mean slope of the ground lately")
    steady_slope = F64(doc="mean slope along the path when the run began")
    path_slope = F64(doc="mean slope along the path lately")
    travel_m = F64(unit="m", doc="distance travelled since the run began")
    top_z_m = F64(unit="m", doc="greatest height of the tool in the run")
    low_z_m = F64(unit="m", doc="least height of the tool in the run")
    rate_mps = F64(unit="m/s", doc="mean rate at which it rose or descended in the run")


class Response(Schema):
    """Response of the range to the tool's own motion (`response`)."""

    phase = I64(doc="constant range, tested by holding, by lifting; RESPONSE_FAILED: it does not respond")
    t_ns = I64(unit="ns", doc="timestamp of the newest sample; 0: none")
    lift_m = F64(unit="m", doc="by which the setpoint is shifted up in a long run and in a lift")
    rises = I64(doc="1: the tool climbs, or climbed when the test began")
    excess_m = F64(unit="m", doc="unshifted setpoint above the tool, less its lag, when the shift began")
    missing_m = F64(unit="m", doc="by which the tool misses a lift; of an ascent, a running mean")
    test_z_m = F64(unit="m", doc="height of the tool when phase or shift began")
    ceiling_z_m = F64(unit="m", doc="greatest setpoint in a lift, and of a sensor that did not respond")
    test_ns = I64(unit="ns", doc="when phase or shift began")
    swing_m = F64(unit="m", doc="half the spread of the ranges in a descent that is tested; 0: another test")
    settled_ns = I64(
        unit="ns", doc="the tool is back from a test or shift; before, no sign of a fault counts"
    )
    proven_m = F64(unit="m", doc="mean range that answered a test or shift; 0: the tool is back from it")


class Repeats(Schema):
    """Ranges in a row that repeat the first of them (`repeated_ranges`)."""

    count = I64(doc="their number")
    range_m = F64(unit="m", doc="the first of them")
    tool_z_m = F64(unit="m", doc="height of the tool then")
    setpoint_m = F64(unit="m", doc="its setpoint then")
    usual = F64(doc="longest such run lately")
    equal = I64(doc="how many of them equal the first, which counts")
    usual_equal = F64(doc="most of these lately")
    chance = F64(doc="probability that noise makes so many equal")
    unused = I64(doc="1: the newest range repeats although the tool has moved, and is not used")


class Descent(Schema):
    """Descent of the tool, and the ranges in it (`descent`)."""

    scatter_m = F64(unit="m", doc="mean deviation of ranges from their running mean, without outliers")
    samples = I64(doc="samples in it")
    offset_m = F64(unit="m", doc="stand-off in it")
    changed_ns = I64(unit="ns", doc="timestamp of the sample at which that was set")
    top_z_m = F64(unit="m", doc="height of the tool where it began")
    low_z_m = F64(unit="m", doc="least height since then")
    floor_z_m = F64(unit="m", doc="least height before it")
    reach_m = F64(unit="m", doc="shorter descents are explained; grows with each test that is answered")
    slope = F64(doc="RMS slope of the ground where it began")
    travel_m = F64(unit="m", doc="distance travelled since then")
    error_m = F64(unit="m", doc="mean of range minus stand-off since then")
    range_m = F64(unit="m", doc="running mean of the range")
    least_m = F64(unit="m", doc="least of these means; fades toward them")
    most_m = F64(unit="m", doc="greatest of these means; fades toward them")
    unexplained = I64(doc="1: the ranges do not explain the descent")


class Lookahead(Schema):
    """Look-ahead sensors beyond channel 0 (`lookahead_sensor`)."""

    range_ns = I64(BEAMS, unit="ns", doc="timestamp of the newest range per channel")
    height_m = F64(BEAMS, unit="m", doc="height of it")
    ahead_m = F64(unit="m", doc="distance of the newest footprint ahead of channel 0's; 0: none leads")
    seen_ns = I64(unit="ns", doc="when one of them measured ground ahead most recently")


class Beams(Schema):
    """Footprints of several beams, and their faults (`beam_detection`)."""

    footprint_m = F64(BEAMS * 3, unit="m", doc="newest footprint per beam")
    t_ns = I64(BEAMS, unit="ns", doc="timestamp of that; 0: none yet")
    round_ns = I64(unit="ns", doc="time in which beams that are read by turns each have a sample")
    late_s = F64(BEAMS, unit="s", doc="usual lateness of each beam behind the reference")
    reach_s = F64(unit="s", doc="a footprint may be late by so much")
    repeat_range_m = F64(BEAMS, unit="m", doc="first range of a run of like ones")
    repeat_ns = I64(BEAMS, unit="ns", doc="when that run began; 0: none yet")
    deviation = F64(BEAMS, doc="height above the median, in gates")
    accepted = I64(BEAMS, doc="1: in the plane fit")
    blocked = I64(doc="beams whose range stays while the tool's motion changes those of two others")
    old = I64(BEAMS, doc="1: the newest footprint is of another round than that of the reference")
    outside_m = F64(BEAMS, unit="m", doc="way of the tool since the beam is nearer than the gate allows")
    outside_count = I64(BEAMS, doc="samples outside the gate minus those inside since")
    weight = F64(BEAMS, doc="weight in the plane fit")
    height_m = F64(BEAMS, unit="m", doc="height under the tool by each beam")
    sorted_m = F64(BEAMS, unit="m", doc="scratch: those, sorted")
    axis_x_m = F64(unit="m", doc="where the tool's axis meets the ground")
    axis_y_m = F64(unit="m")
    reference = I64(doc="channel whose samples are the follower's samples")
    inconsistent = I64(doc="> 0: no majority of beams, the nearer ground counts; samples until it ends")


class BeamRuns(Schema):
    """Runs of constant ranges per beam of a ring of three or four (`blocked_beam`)."""

    mean_m = F64(BEAMS, unit="m", doc="mean of the newest ranges")
    range_m = F64(BEAMS, unit="m", doc="mean of the run")
    samples = I64(BEAMS, doc="samples of the run")
    t_ns = I64(BEAMS, unit="ns", doc="timestamp from which changes of the others are counted")
    z_m = F64(BEAMS, unit="m", doc="height of the sensor then")
    motion_m = F64(BEAMS, unit="m", doc="greatest motion of the sensor since then")
    changes_before = I64(BEAMS, doc="`changes` then")
    changes = I64(doc="changes of mean ranges, of beams by turns")
    changed = I64(doc="beam of the newest one")


class Plane(Schema):
    """Slopes, their rates and the mean curvature (`plane_fit`)."""

    count = I64(doc="planes fitted so far")
    t_ns = I64(unit="ns", doc="time of the slopes; 0: none yet")
    first_ns = I64(unit="ns", doc="timestamp of the first sample; 0: none yet")
    rank = I64(doc="slopes updated by the newest sample: 2 both, 1 along a line, 0 none")
    slope_x = F64(unit="1", doc="slopes of the plane")
    slope_y = F64(unit="1")
    slope_rate_x_hz = F64(unit="1/s", doc="their rates")
    slope_rate_y_hz = F64(unit="1/s")
    fitted_x = F64(unit="1", doc="slopes of the newest plane of rank 2, unfiltered")
    fitted_y = F64(unit="1")
    spread_m2 = F64(unit="m^2", doc="spread of its footprints, where it is less")
    curvature = F64(unit="1/m", doc="mean curvature under the tool, positive in a hollow")
    track_m = F64(3, unit="m", doc="mean of one beam's footprints lately: x, y, z")
    track_beam = I64(doc="that beam")


ROTATION_RUN, ROTATION_TEST, ROTATION_FAILED = range(3)


class Rotation(Schema):
    """Response of the beams to the tool's own rotation (`rotation_response`)."""

    phase = I64(doc="constant deviation, tested by turning back; ROTATION_FAILED: no response")
    t_ns = I64(unit="ns", doc="timestamp of the newest plane; 0: none")
    mean = F64(2, unit="1", doc="running mean of the plane's slopes in the tool's frame")
    run_mean = F64(2, unit="1", doc="that over the run of constant slopes")
    run_ns = I64(unit="ns", doc="when the run began")
    run_axis = F64(3, unit="1", doc="the tool's axis then, world frame")
    test_axis = F64(3, unit="1", doc="direction to which the test turns the tool back")
    test_ns = I64(unit="ns", doc="when the test began, or was last not applied")
    samples = I64(doc="samples of the run; of the test, since the tool is half the way back")
