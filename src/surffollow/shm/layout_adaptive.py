"""State of the default follower: one record per stage of its block diagram.

Lengths and times are dimensionless (`reference_scales`): metres and seconds of a usual robot cell.
Only the stage that owns a record writes it, and `reset`.
"""

from __future__ import annotations

from surffollow.shm.layout_adaptive_estimation import (
    N_AXES,
    N_MODELS,
    N_PERIODS,
    Bank,
    Buffer,
    EarlierBank,
    Estimate,
    Gate,
    Lead,
    Noise,
    Pending,
    Shadow,
    Weights,
)
from surffollow.shm.layout_adaptive_sensing import (
    BeamRuns,
    Beams,
    Clock,
    ConstantRanges,
    Descent,
    Frame,
    Health,
    Hold,
    Kinematics,
    Latency,
    Lookahead,
    Plane,
    Repeats,
    Response,
    Rotation,
    Sample,
)
from surffollow.shm.schema import F64, I64, Nested, Schema

HORIZON = 40  # controller periods of the preview and its plan
N_LATCHES = 128  # setpoints latched that are kept: 256 ms or more
N_PLANTS = 7  # axis models of different time constants

# health of the ranging, from good to bad
OK, SUSPECT, DROPOUT, STUCK, OUT_OF_RANGE, FAULT = 0, 1, 2, 3, 4, 5
HEALTH_NAMES = ("OK", "SUSPECT", "DROPOUT", "STUCK", "OUT_OF_RANGE", "FAULT")

# latched faults of the follower: fault n is bit n - 1
FAULT_NOT_FINITE, FAULT_STUCK, FAULT_LOST, FAULT_CLOSE, FAULT_CLOCK, FAULT_REVERSED = 1, 2, 4, 8, 16, 32
FAULT_NAMES = ("NOT_FINITE", "STUCK", "LOST", "TOO_CLOSE", "CLOCK", "REVERSED")


class Controller(Schema):
    """Periods of the robot's controller (`controller_clock`)."""

    period_ns = I64(unit="ns", doc="begin of the newest controller period")
    asked_ns = I64(unit="ns", doc="newest step of a caller in process without a reading")
    declared_ns = I64(unit="ns", doc="newest of these steps in which no reading was due")
    latched_ns = I64(unit="ns", doc="newest latch")
    interval_ns = F64(unit="ns", doc="usual interval of latches")
    usual_ns = F64(unit="ns", doc="usual length of a controller period; 0: not known")
    latch_pending = I64(doc="1: the demand of the newest period is not latched yet and may change")
    periods = I64(doc="controller periods so far")
    latch_ns = I64(N_PERIODS, unit="ns", doc="ring of latch times")


class Setpoints(Schema):
    """Ring of setpoints."""

    position_m = F64(N_LATCHES, unit="m", doc="the setpoints")
    t_ns = I64(N_LATCHES, unit="ns", doc="time from which each is in force")
    count = I64(doc="setpoints so far")


class OwnSetpoints(Schema):
    """The follower's own setpoints that the controller latched (`own_setpoints`)."""

    latched = Nested(Setpoints, doc="by a controller that latches the demands at its reports")
    given = Nested(Setpoints, doc="by one that latches each demand")
    takes_each = I64(doc="1: it latches each demand; 0: those at its reports")
    compared = I64(doc="reports compared, as many as a mean is of at most")
    error_m = F64(unit="m", doc="mean error of the observed axis")
    other_error_m = F64(unit="m", doc="what it would be, did the controller latch the others")
    newest_m = F64(unit="m", doc="setpoint of the cycle before")


class Plant(Schema):
    """Identified axis (`plant_identification`)."""

    position_m = F64(N_PLANTS, unit="m", doc="axis models of different τ that follow them")
    velocity_mps = F64(N_PLANTS, unit="m/s", doc="their velocity")
    error_m2 = F64(N_PLANTS, unit="m^2", doc="their squared errors against the pose reports")
    axis_m = F64(unit="m", doc="observed axis: the model with τ in force, corrected by reports")
    axis_mps = F64(unit="m/s", doc="its velocity")
    disturbance_mps = F64(unit="m/s", doc="velocity of the tool beyond that of its axis: wind, current, load")
    mean_m = F64(
        unit="m", doc="mean distance of the reports above where the observed axis leads, with its sign"
    )
    spread_m = F64(unit="m", doc="the same without sign")
    offset_m = F64(unit="m", doc="height of the newest report above the observed axis")
    scatter_m = F64(unit="m", doc="usual distance of a report from where the observed axis leads; 0: unknown")
    begins = I64(doc="1: behind an SFReset, a time constant configured anew takes effect")
    t_ns = I64(unit="ns", doc="time up to which the axes are propagated")
    tau_s = F64(unit="s", doc="time constant in force; 0: not begun")
    tau_configured_s = F64(unit="s", doc="time constant that identification began with")


class Blend(Schema):
    """Blended setpoint and its filter (`setpoint_blend`)."""

    axis_m = F64(N_AXES, unit="m", doc="newest setpoints of the simulated axes")
    model_m = F64(N_MODELS, unit="m", doc="newest setpoints of the models, with the lead that they have")
    model_slope = F64(N_MODELS, doc="their slopes along the path")
    setpoint_m = F64(unit="m", doc="their blend")
    rate_mps = F64(unit="m/s", doc="its rate as the models predict it")
    t_ns = I64(unit="ns", doc="when it was made")
    tracked_m = F64(unit="m", doc="the first one with the newest accepted sample")
    tracked_ns = I64(unit="ns", doc="timestamp of that sample")
    filtered_m = F64(unit="m", doc="behind the deadband filter")


class Setpoint(Schema):
    """Jerk-limited setpoint (`setpoint_limits`)."""

    position_m = F64(unit="m", doc="setpoint of the tool: where the demand points")
    velocity_mps = F64(unit="m/s", doc="its rate")
    acceleration_mps2 = F64(unit="m/s^2", doc="and the rate of that")
    t_ns = I64(unit="ns", doc="when it was made; 0: begin at the tool")
    in_dryrun = I64(doc="1: made in DRYRUN, not applied")
    approaching = I64(doc="1: it began at the tool and has not arrived yet")
    interval_s = F64(unit="s", doc="usual interval of calls, an upper estimate; 0: not known")
    min_interval_s = F64(unit="s", doc="shortest interval lately; 0: not known")
    max_accel_mps2 = F64(unit="m/s^2", doc="limit of its acceleration then")
    max_jerk_mps3 = F64(unit="m/s^3", doc="limit of its jerk then; 0: not known")


class Preview(Schema):
    """Preview of the terrain and its share of the setpoint (`preview`)."""

    share = F64(doc="share of the planned setpoint, 0 to 1")
    suspended_until_ns = I64(unit="ns", doc="no preview until then")
    sensed_periods = I64(doc="periods of ground known from channel 0 ahead of the tool; 0: it does not lead")
    ground_m = F64(HORIZON, unit="m", doc="ground under the tool per controller period")
    predicted_m = F64(unit="m", doc="height as the model bank predicted it over a distance …")
    predicted_from_m = F64(unit="m", doc="… from this arc length")
    error_m2 = F64(unit="m^2", doc="mean squared error of such predictions")
    mean_m = F64(unit="m", doc="recent mean of the height")
    offset_m2 = F64(unit="m^2", doc="mean squared offset from it")


class Known(Schema):
    """Known ground against the sensor under the tool (`known_ground`)."""

    bias_m = F64(2, unit="m", doc="mean of height by channel 0 minus known height: sensor ahead, map")
    compared = I64(2, doc="samples in that mean")
    difference_m2 = F64(2, unit="m^2", doc="mean squared difference beyond that")
    contradictions = I64(doc="samples in a row that disagree with it")
    trusted_from_m = F64(unit="m", doc="arc length from which it is used again")
    peak_m = F64(unit="m", doc="greatest height lately, older ones fade with the distance; 0: none yet")
    descent_m = F64(unit="m", doc="further descent of a plan that confirmed drops allow")


class Plan(Schema):
    """Preview control (`preview_control`)."""

    setpoint_m = F64(unit="m", doc="setpoint of the plan")
    position_m = F64(HORIZON, unit="m", doc="planned axis")
    acceleration_m = F64(HORIZON, unit="m", doc="planned accelerations [m per period²]")
    multiplier_m = F64(HORIZON, unit="m", doc="their multipliers")
    factor_0 = F64(HORIZON, doc="pentadiagonal factors: D …")
    factor_1 = F64(HORIZON, doc="… first …")
    factor_2 = F64(HORIZON, doc="… and second subdiagonal of L")


class Attitude(Schema):
    """Attitude setpoint (`attitude`)."""

    axis = F64(3, unit="1", doc="setpoint of the tool's axis, behind the limits")
    angular_velocity_radps = F64(3, unit="rad/s", doc="its rate")
    t_ns = I64(unit="ns", doc="when it was made; 0: begin at the tool")


class AdaptiveState(Schema):
    """State of the default follower; all zero means nothing seen yet."""

    clock = Nested(Clock)
    kinematics = Nested(Kinematics)
    hold = Nested(Hold)
    latency = Nested(Latency)
    sample = Nested(Sample)
    health = Nested(Health)
    frame = Nested(Frame)
    run = Nested(ConstantRanges)
    response = Nested(Response)
    repeats = Nested(Repeats)
    descent = Nested(Descent)
    noise = Nested(Noise)
    pending = Nested(Pending)
    gate = Nested(Gate)
    bank = Nested(Bank)
    earlier = Nested(EarlierBank)
    shadow = Nested(Shadow)
    weights = Nested(Weights)
    lead = Nested(Lead)
    estimate = Nested(Estimate)
    controller = Nested(Controller)
    own = Nested(OwnSetpoints)
    plant = Nested(Plant)
    blend = Nested(Blend)
    setpoint = Nested(Setpoint)
    buffer = Nested(Buffer)
    lookahead = Nested(Lookahead)
    known = Nested(Known)
    preview = Nested(Preview)
    plan = Nested(Plan)
    beams = Nested(Beams)
    beam_runs = Nested(BeamRuns)
    plane = Nested(Plane)
    rotation = Nested(Rotation)
    attitude = Nested(Attitude)


# why the health is not OK, or, REASON_TESTED, why a healthy follower does not go to the stand-off
REASON_NAMES = (
    "",
    "no pose within its time-out",
    "samples outside the innovation gate are unconfirmed",
    "no reading for several sample intervals",
    "readings outside the window",
    "range does not respond to the tool's motion",
    "no sample entered the estimate within the loss time-out",
    "estimate was not finite and began anew",
    "timestamps went back; readings count as old as usual",
    "sensors disagree without a majority; the nearer ground counts",
    "reported position jumped; ground known from before is not used",
    "readings do not respond to the tool's rotation; the tool does not rotate",
    "some sensors give no reading within the window",
    "readings arrive later than they did: delayed, or the sensor's clock is slow",
    "range repeats the ones before although the tool moves; it is not used",
    "some sensors disagree with the others and are left out",
    "range stays too long while the tool descends steeply: it may not see the ground",
    "the range is tested: the tool is held or raised until it responds",
    "readings of some sensors are older than those of the others and are left out",
    "the beam does not point downward: the frame of the pose or the mount is wrong",
    "range shrinks when the tool rises: its height has the wrong sign, or the sensor is in its fold-back",
    "a single reading so far: the interval of the sensor is not known yet",
)
(
    REASON_NONE,
    REASON_POSE,
    REASON_PENDING,
    REASON_NO_READING,
    REASON_OUTSIDE,
    REASON_STUCK,
    REASON_LOST,
    REASON_NOT_FINITE,
    REASON_TIMESTAMPS,
    REASON_SENSORS,
    REASON_POSE_JUMP,
    REASON_ROTATION,
    REASON_SILENT,
    REASON_LATE,
    REASON_REPEATED,
    REASON_LEFT_OUT,
    REASON_DESCENT,
    REASON_TESTED,
    REASON_OLD,
    REASON_UPWARD,
    REASON_REVERSED,
    REASON_SINGLE,
) = range(22)
REASON_CHANNELS = 8  # first bit of a reason that names a channel


def reason_text(reason: int) -> str:
    """A published reason in words, with the channels that it names; "?": unknown to this version."""
    number, channels = reason & (1 << REASON_CHANNELS) - 1, reason >> REASON_CHANNELS
    if reason < 0 or number >= len(REASON_NAMES):
        return "?"
    named = [str(c) for c in range(channels.bit_length()) if channels >> c & 1]
    if not named:
        return REASON_NAMES[number]
    return f"{REASON_NAMES[number]} (channel{'s' if len(named) > 1 else ''} {', '.join(named)})"
