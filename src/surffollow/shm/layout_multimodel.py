"""State of the multiple-model follower: one record per stage of its block diagram.

Lengths and times are plain numbers: multiples of `Reference.length_m` and `Reference.time_ns`, two powers
of two
that follow from the stand-off and the axis' time constant. Only the stage that owns a record writes it.
"""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, Nested, Schema

N_MODELS = 18  # most models in the bank
N_PLANTS = 5  # axis models of different time constants
N_AXES = N_MODELS + N_PLANTS
SETPOINTS = 64  # controller periods that the shadow axes look back
BUFFER = 512  # accepted heights that the terrain buffer holds


class Tuning(Schema):
    """Constants of the follower, all dimensionless; defaults in `forecast.tuning`. No kernel writes them."""

    n_models = I64(doc="models in the bank")
    models = F64(N_MODELS * 3, doc="per model: kind, memory [samples], fading distance [reactions]")
    bank_clip = F64(doc="innovations turn slopes by no more than so many usual ones")
    wave_rate = F64(doc="rate of its running means, per radian")
    wave_mean_drift = F64(doc="drift of a wave's mean, share of its amplitudes' drift")
    first_wave_reactions = F64(doc="wavelength assumed at first, in reaction distances")
    gate_gate = F64(doc="gate, in usual innovations")
    gate_rate = F64(doc="rate of the usual innovation, per sample")
    gate_confirm = I64(doc="agreeing samples that confirm a step …")
    gate_confirm_slow = I64(doc="… when a sample interval is long for the axis")
    gate_stays = F64(doc="factor of the travel asked for, per step that stayed")
    gate_slow = F64(doc="such an interval, in time constants of the axis")
    gate_slot_share = F64(doc="hollows wider than this share of the stand-off are ground")
    gate_standing_taus = F64(
        doc="time constants after which agreeing samples, or the first after a gap, need no travel"
    )
    gate_growth = F64(doc="growth of the usual innovation per outlier that agrees with none")
    index_recent = F64(doc="recent horizon, in reaction times")
    index_longer = F64(doc="longer horizon")
    index_power = F64(doc="power of the recent index")
    index_longer_power = F64(doc="power of the longer one")
    index_floor = F64(doc="errors below this share of the noise are equal")
    index_calm = F64(doc="penalty of a model, over its memory: short ones are restless")
    setpoint_fade_reactions = F64(doc="distance over which slopes are trusted without samples")
    setpoint_drive = F64(doc="gain on the predicted position error, per τ over the dead time of the poses")
    setpoint_useful = F64(doc="controller periods of full acceleration that the set point may ask for")
    setpoint_smoothing = F64(doc="time constant over which jumps of the blend pass, in controller periods")


class Reference(Schema):
    """Reference scales and what was told, in plain numbers (`scales`)."""

    length_m = F64(unit="m", doc="reference length, a power of two; 0: not begun")
    time_ns = I64(unit="ns", doc="reference time, a power of two")
    epoch_ns = I64(unit="ns", doc="when plain time is 0")
    standoff = F64(doc="desired stand-off")
    tau = F64(doc="assumed time constant of the axis")
    v_max = F64(doc="its velocity limit")
    a_max = F64(doc="its acceleration limit")
    max_demand = F64(doc="limit of the demand")
    toward_factor = F64(doc="share of the velocity limit toward the surface")
    too_close = F64(doc="nearer ranges latch TOO_CLOSE")
    too_close_exit = F64(doc="farther ranges may release it")
    near = F64(doc="nearest range of the window")


class Kinematics(Schema):
    """Tool position and lateral velocity (`sensing.kinematics`)."""

    now = F64(doc="latest time heard of")
    pose_t = F64(doc="timestamp of the newest pose")
    poses = I64(doc="pose count at which this was computed")
    interval = F64(doc="usual interval of pose reports; 0: not known")
    x = F64(doc="newest position")
    y = F64()
    z = F64()
    tip_x = F64(doc="from the tool to the ground point on its axis")
    tip_y = F64()
    drop = F64(doc="how much higher the tool shall be than the ground it points at")
    vx = F64(doc="lateral velocity")
    vy = F64()
    climb = F64(doc="vertical velocity")
    speed = F64(doc="lateral speed; 0 while it is not significant")


class Sample(Schema):
    """The newest reading and sample hold (`sensing.sample`)."""

    fresh = I64(doc="1: this cycle has a new sample")
    t = F64(doc="its timestamp")
    range = F64(doc="its range")
    range_1 = F64(doc="range of the sample before")
    range_2 = F64(doc="range of the one before that")
    height = F64(doc="height of its footprint")
    x = F64(doc="footprint")
    y = F64()
    way = F64(doc="distance travelled since the sample before")
    dt = F64(doc="time since the sample before")
    turn = F64(doc="cosine of the turn of the direction of travel since the sample before")
    count = I64(doc="samples so far")
    interval = F64(doc="usual interval; 0: not known")
    spacing = F64(doc="usual distance travelled between samples while moving; 0: not known")
    delay = F64(doc="usual delay of arrival")
    backward = I64(doc="timestamps in a row before the newest sample's")
    shift = F64(doc="correction of timestamps that went back; 0: none")
    direction_x = F64(doc="direction of travel at the sample")
    direction_y = F64()
    lead = F64(doc="how far the footprint is ahead of the point under the tool")


class Health(Schema):
    """Health of the ranging, with reasons (`sensing.health`)."""

    state = I64(doc="see HEALTH_NAMES")
    reason = I64(doc="see REASON_NAMES")
    faults = I64(doc="latched fault bits")
    close = I64(doc="1: TOO_CLOSE latched")
    close_z = F64(doc="height of the tool where the branch was judged last")
    close_range = F64(doc="range there")
    flicker = F64(doc="running median of |second difference| of ranges")
    stuck_n = I64(doc="ranges in a row without the noise of the sensor")
    stuck_z = F64(doc="height of the tool where that began")
    stuck_range = F64(doc="range there")
    stuck = I64(doc="1: stuck-at fault")
    missed = I64(doc="readings outside the window in a row")


class Noise(Schema):
    """Noise of the readings from second differences of accepted heights (`estimation.noise`)."""

    count = I64(doc="accepted heights in a row")
    recent = F64(2, doc="the two accepted heights before the last one")
    median = F64(doc="running median of |second difference|")
    sigma = F64(doc="standard deviation of a reading")


class Gate(Schema):
    """Innovation gate (`estimation.innovation_gate`)."""

    verdict = I64(doc="of the newest sample: see innovation_gate")
    innovation = F64(doc="of the newest sample")
    scale = F64(doc="usual innovation")
    pending = I64(doc="unconfirmed samples that agree")
    pending_sum = F64(doc="sum of their innovations")
    pending_last = F64(doc="height of the last of them")
    pending_change = F64(doc="its rise over the one before")
    course = I64(doc="1: they agree on a steady course, not on a height")
    pending_way = F64(doc="distance travelled since the first")
    pending_t = F64(doc="timestamp of the first")
    rejected = I64(doc="outliers in a row that did not agree with the one before")
    shift = F64(doc="height of the step just confirmed")
    slots = F64(doc="how likely a hollow is a slot: 1 not known, toward 0 by steps that stayed")
    since = F64(doc="distance travelled since the last confirmed step")
    stepped = F64(doc="its height; 0: none")
    accepted_t = F64(doc="timestamp of the last sample that entered the estimate")


class Bank(Schema):
    """Kalman filters of the ground (`estimation.model_bank`); covariances in units of the noise variance."""

    samples = I64(doc="samples since the start; 0: begin with the next")
    x = F64(N_MODELS * 3, doc="states: height, slope (wave: mean, sine, cosine)")
    p = F64(N_MODELS * 6, doc="covariances 00 01 02 11 12 22")
    omega = F64(doc="angular wave number of the wave model; 0: not known")
    mean_h = F64(doc="running mean of the height")
    mean_s = F64(doc="running mean of the slope")
    power_h = F64(doc="running variance of the height")
    power_s = F64(doc="running variance of the slope")


class Weights(Schema):
    """Performance index and weights of the models (`estimation.model_weights`)."""

    scored = I64(doc="samples that entered the index")
    recent = F64(N_MODELS, doc="squared error of the shadow axis, recent horizon")
    longer = F64(N_MODELS, doc="the same over the longer horizon")
    w = F64(N_MODELS, doc="weights, sum 1")
    cost = F64(N_MODELS, doc="logarithm of the index")
    height = F64(doc="blended height at the last sample")
    slope = F64(doc="blended slope")
    sigma = F64(doc="uncertainty of the height, spread of the models included")


class Shadow(Schema):
    """Simulated axes (`plant.shadow_axes`): one per model, and some of other τ behind the own set point."""

    ticks = I64(doc="controller periods recorded")
    t = F64(SETPOINTS, doc="ring of their times")
    setpoint = F64((N_MODELS + 1) * SETPOINTS, doc="ring of set points per model, and the own one last")
    z = F64(N_AXES, doc="position")
    v = F64(N_AXES, doc="velocity")
    models_t = F64(doc="time up to which the models' axes are simulated")
    plants_t = F64(doc="time up to which the others are")


class Plant(Schema):
    """Identified axis (`plant.identification`)."""

    tau = F64(doc="time constant in force; 0: not begun")
    tau_told = F64(doc="time constant that identification began with")
    error = F64(N_PLANTS, doc="squared error of each axis model against the reports")
    reports = I64(doc="reports compared")


class Setpoint(Schema):
    """Blended set point and its filter (`setpoint.blend`, `setpoint.limits`)."""

    t = F64(doc="when it was made")
    active = I64(doc="1: there is a set point to go on from")
    raw = F64(doc="blend of the models' set points")
    rate = F64(doc="how fast the models expect it to change")
    position = F64(doc="where the axis should be when the demand acts")
    filtered = F64(doc="the same, not moved by less than the permitted variance")
    value = F64(doc="behind the limits: where the demand points")


class Buffer(Schema):
    """Accepted heights along the path (`terrain.buffer`)."""

    count = I64(doc="heights ever stored since the start")
    s = F64(BUFFER, doc="ring of distances travelled")
    h = F64(BUFFER, doc="ring of heights")
    at = F64(doc="distance travelled by the footprint of the newest one")


class MultimodelState(Schema):
    """State of the multiple-model follower; all zero means nothing seen yet."""

    tuning = Nested(Tuning)
    reference = Nested(Reference)
    kinematics = Nested(Kinematics)
    sample = Nested(Sample)
    health = Nested(Health)
    noise = Nested(Noise)
    gate = Nested(Gate)
    bank = Nested(Bank)
    weights = Nested(Weights)
    shadow = Nested(Shadow)
    plant = Nested(Plant)
    setpoint = Nested(Setpoint)
    buffer = Nested(Buffer)


# why the health is not OK, in the order of HEALTH_NAMES' severity
REASON_NAMES = (
    "",
    "first samples",
    "samples outside the innovation gate are unconfirmed",
    "no reading for several sample intervals",
    "readings outside the window",
    "range does not respond to the tool's motion",
    "no sample entered the estimate within the loss time-out",
    "estimate was not finite and began anew",
    "timestamps went back; readings count as old as usual",
    "sensors disagree without a majority; the nearer ground counts",
    "reported position jumped; ground known from before is not used",
)
(
    REASON_NONE,
    REASON_FIRST,
    REASON_PENDING,
    REASON_NO_READING,
    REASON_OUTSIDE,
    REASON_STUCK,
    REASON_LOST,
    REASON_NOT_FINITE,
    REASON_TIMESTAMPS,
    REASON_SENSORS,
    REASON_POSE_JUMP,
) = range(11)
