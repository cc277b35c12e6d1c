"""State of the default follower's estimation and terrain: one record per stage (`layout_adaptive`)."""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, Nested, Schema

# models of the bank: levels and slopes, from number CURVES on curves, from WAVES on waves; waves lead fully
N_MODELS, CURVES, WAVES = 20, 9, 12
N_AXES = N_MODELS + WAVES  # simulated: of all models with their lead, of those that may lead less without it
N_PERIODS = 64  # controller periods that the setpoint rings hold: 640 ms
PENDING_HEIGHTS = 32  # pending heights that enter the terrain buffer when a step is confirmed
BUFFER_CELLS = 512  # of the terrain buffer, 1 mm each
MEMORY_CELLS = 1 << 16  # of the terrain memory

WITHHELD, PENDING, ACCEPTED, STEP, RESTART = range(5)  # what becomes of a sample (`innovation_gate`)


class Noise(Schema):
    """Noise of the readings (`noise`)."""

    sigma_m = F64(
        unit="m",
        doc="standard deviation of a reading, by the running median of second differences",
    )
    recent_m = F64(2, unit="m", doc="the two accepted heights before the newest one")
    range_sigma_m = F64(unit="m", doc="standard deviation of a range, likewise; without the noise of poses")
    recent_range_m = F64(2, unit="m", doc="the two accepted ranges before the newest one")


class Pending(Schema):
    """Samples outside the innovation gate (`pending_samples`)."""

    samples = I64(doc="pending samples that agree")
    innovation_m = F64(unit="m", doc="sum of their innovations")
    arc_length_m = F64(unit="m", doc="sum of their arc lengths")
    height_m = F64(unit="m", doc="sum of their heights")
    travel_m = F64(unit="m", doc="distance travelled since the first of them")
    t_ns = I64(unit="ns", doc="timestamp of the first of them")
    kept_arc_length_m = F64(PENDING_HEIGHTS, unit="m", doc="ring of their arc lengths")
    kept_height_m = F64(PENDING_HEIGHTS, unit="m", doc="and heights")
    rejected = I64(doc="outliers that did not agree with the one before, less the accepted samples since")
    least_m = F64(unit="m", doc="least innovation of those, 0 at most")
    greatest_m = F64(unit="m", doc="greatest innovation of those, 0 at least")
    opposed = I64(doc="of those, outliers on the other side than the one before")
    odd = I64(doc="1: the newest outlier does not agree with the pending ones, which stay")


class Gate(Schema):
    """Innovation gate and steps (`innovation_gate`)."""

    scale_m = F64(unit="m", doc="usual innovation of the blend")
    width_m = F64(unit="m", doc="width of the gate for the newest sample")
    rise_limit_m = F64(unit="m", doc="greatest rise of the ground up to the newest sample")
    unconfirmed_m = F64(unit="m", doc="innovation held back for a second sample; 0: none")
    withheld_m = F64(unit="m", doc="innovation of a nearer sample that waits for a second one; 0: none")
    nearer = I64(doc="1: the newest sample was nearer than the models follow; so may the next one be")
    slot_likelihood = F64(
        doc="likelihood that a hollow is a slot: 1 not known, less by steps that stayed; 0: no estimate yet"
    )
    travel_since_step_m = F64(unit="m", doc="distance travelled since the last confirmed step")
    step_m = F64(unit="m", doc="height of that step; 0: none")
    step_ns = I64(unit="ns", doc="when it was confirmed")


class Bank(Schema):
    """Kalman filters of the ground (`model_bank`)."""

    height_m = F64(N_MODELS, unit="m", doc="height h at the newest sample")
    slope = F64(N_MODELS, unit="1", doc="slope θ")
    curvature = F64(N_MODELS, unit="1/m", doc="curvature κ")
    p00 = F64(N_MODELS, doc="covariance of h, θ and κ")
    p01 = F64(N_MODELS)
    p02 = F64(N_MODELS)
    p11 = F64(N_MODELS)
    p12 = F64(N_MODELS)
    p22 = F64(N_MODELS)
    wave_number = F64(N_MODELS, unit="1/m", doc="wave number ω of a wave")
    f01 = F64(N_MODELS, doc="transition of h, θ and κ over a distance")
    f02 = F64(N_MODELS)
    f11 = F64(N_MODELS)
    f12 = F64(N_MODELS)
    f21 = F64(N_MODELS)
    f22 = F64(N_MODELS)
    rise_m = F64(N_MODELS, unit="m", doc="change of height up to the point ahead")
    slope_ahead = F64(N_MODELS, doc="slope there")
    bend_ahead = F64(N_MODELS, unit="1/m", doc="dθ/ds there")


class EarlierBank(Schema):
    """The bank without its newest sample (`earlier_bank`)."""

    kept = I64(doc="1: the newest sample is that of a slow sensor, and may be taken back")
    bank = Nested(Bank)


class Shadow(Schema):
    """Shadow axes of the models (`shadow_axes`)."""

    t_ns = I64(unit="ns", doc="time up to which the axes are simulated")
    setpoint_m = F64(N_AXES * N_PERIODS, unit="m", doc="setpoints of all axes, per period of a ring")
    position_m = F64(N_AXES, unit="m", doc="position of the axes")
    velocity_mps = F64(N_AXES, unit="m/s", doc="velocity")
    before_m = F64(2 * N_MODELS, unit="m", doc="setpoints of the models in the two periods before")
    effort = F64(N_MODELS, unit="m^2/s^4", doc="mean squared acceleration of the setpoints")


class Weights(Schema):
    """Performance index and weights of the models (`model_weights`)."""

    scored = I64(doc="samples that entered the index, up to FULL_POWER_SAMPLES")
    recent_m2 = F64(N_MODELS, unit="m^2", doc="squared error of the shadow axis, recent horizon")
    longer_m2 = F64(N_MODELS, unit="m^2", doc="the same over the longer horizon")
    cost = F64(N_MODELS, doc="logarithm of the index with penalties, then its exponential")
    weight = F64(N_MODELS, doc="weights, sum 1")
    waiting_s = F64(unit="s", doc="time since the weights were updated")


class Lead(Schema):
    """Part of the lead that the setpoints of a model leave out (`setpoint_lead`)."""

    excess_m2 = F64(2 * WAVES, unit="m^2", doc="mean of e1 (e1 − e0), errors with the lead, without it")
    effect_m2 = F64(2 * WAVES, unit="m^2", doc="mean of (e1 − e0)²; both over the recent, the longer horizon")
    left_out = F64(N_MODELS, doc="part of the lead by τ times the rate of the height, 0 to 1; of a wave 0")


class Estimate(Schema):
    """Blended estimate of the ground at the newest sample (`estimate`)."""

    samples = I64(doc="samples that entered the estimate; 0: initialise with the next one")
    sample_ns = I64(unit="ns", doc="timestamp up to which the models are propagated")
    accepted_ns = I64(unit="ns", doc="timestamp of the last sample that entered the estimate")
    confirmed_ns = I64(unit="ns", doc="the same while the estimate had enough samples; 0: not begun")
    in_frame_ns = I64(unit="ns", doc="the same of a sample from behind the newest jump of the frame")
    settle_ns = I64(unit="ns", doc="the performance index is frozen until then")
    arc_length_m = F64(unit="m", doc="distance travelled by the footprint")
    height_m = F64(unit="m", doc="blended height")
    slope = F64(unit="1", doc="blended slope")
    rests = I64(doc="1: the tool rests, and the path is time")
    kept_slope = F64(unit="1", doc="slope along the way before a rest")
    kept_slope_power = F64(unit="1", doc="slope_power before a rest")
    slope_power = F64(unit="1", doc="mean squared slope over the last metre")
    quick_slope_power = F64(unit="1", doc="the same by the model `QUICK`, whatever its weight")
    sigma_m = F64(unit="m", doc="standard deviation of the height, spread of the models included")


class Buffer(Schema):
    """Terrain buffer: ring of cells along the path (`terrain_buffer`)."""

    cell = I64(BUFFER_CELLS, doc="number of the cell along the path, plus one; 0: empty")
    count = F64(BUFFER_CELLS, doc="heights in its mean")
    height_m = F64(BUFFER_CELLS, unit="m", doc="mean height")
    arc_length_m = F64(BUFFER_CELLS, unit="m", doc="mean arc length")
    x_m = F64(BUFFER_CELLS, unit="m", doc="place of its first height")
    y_m = F64(BUFFER_CELLS, unit="m")
    newest_arc_length_m = F64(unit="m", doc="arc length of the newest height")
    newest_height_m = F64(unit="m", doc="that height")


class MemoryCell(Schema):
    """A cell of the terrain memory (`terrain_memory`)."""

    ix = I64(doc="column in the world's x-y plane")
    iy = I64(doc="row")
    t_ns = I64(unit="ns", doc="when it was last written")
    n = F64(doc="heights in its mean")
    height_m = F64(unit="m", doc="mean height")
    n_before = F64(doc="heights in the mean before this pass began")
    height_before_m = F64(unit="m", doc="that mean")
