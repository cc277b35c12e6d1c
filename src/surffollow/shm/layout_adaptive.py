"""What the adaptive follower remembers: path, candidate models with their shadow axes, quarantine, noise."""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, Schema

CANDIDATES = 48  # most models in the bank
CELLS = 512  # of ground seen ahead, 1 mm each
KEPT = 32  # quarantined samples that become ground when they are believed
HORIZON = 40  # ticks planned ahead
TRENDS = 16  # straight lines that forecast the range
LAGS = 4  # horizons at which they are judged
SNAPSHOTS = 32
PLANTS = 5  # axes of different τ
TICKS = 64  # controller ticks remembered per candidate: 640 ms of set points

# health of the ranging, in the order of what is reported first
OK, SUSPECT, DROPOUT, STUCK, OUT_OF_RANGE, FAULT = 0, 1, 2, 3, 4, 5
HEALTH_NAMES = ("OK", "SUSPECT", "DROPOUT", "STUCK", "OUT_OF_RANGE", "FAULT")


class AdaptiveState(Schema):
    """State of the adaptive mode; all zero means nothing seen yet."""

    now_ns = I64(unit="ns", doc="latest time any step was told")
    held_ns = I64(unit="ns", doc="time of the last new reading of channel 0")
    held_m = F64(unit="m", doc="its value: what repeats it is no news")
    sample_ns = I64(unit="ns", doc="stamp of the last sample the models were carried to")
    accepted_ns = I64(unit="ns", doc="stamp of the last sample that entered the estimate")
    samples = I64(doc="samples that entered the estimate; 0: start anew with the next")
    late_s = F64(unit="s", doc="how late samples arrive")
    path_m = F64(unit="m", doc="way of the footprint so far")
    lead_m = F64(unit="m", doc="how far the footprint is ahead of the tool")
    foot_x_m = F64(unit="m", doc="footprint of the last sample")
    foot_y_m = F64(unit="m")
    speed_x_mps = F64(unit="m/s", doc="lateral velocity of the tool")
    speed_y_mps = F64(unit="m/s")
    speed_mps = F64(unit="m/s")
    climb_mps = F64(unit="m/s", doc="vertical velocity of the tool")
    scale_m = F64(unit="m", doc="typical one-step innovation of the blend")
    noise_m = F64(unit="m", doc="reading noise, from second differences")
    median_m = F64(unit="m", doc="running median of |second difference|")
    recent_m = F64(2, unit="m", doc="the two accepted heights before the last one")
    quarantined = I64(doc="samples in quarantine that agree")
    quarantine_m = F64(unit="m", doc="sum of their innovations")
    quarantine_way_m = F64(unit="m", doc="way since the first of those")
    kept_s_m = F64(KEPT, unit="m", doc="where quarantined samples were")
    kept_h_m = F64(KEPT, unit="m", doc="their heights")
    returned = F64(doc="how likely a quarantine ends without a step: 1 unknown or slots, to 0 steps")
    since_step_m = F64(unit="m", doc="way since the last believed step")
    settle_ns = I64(unit="ns", doc="scores are frozen until this time")
    tick_ns = I64(unit="ns", doc="last controller tick assumed")
    ticks = I64(doc="ticks assumed so far")
    tick_t_ns = I64(TICKS, unit="ns", doc="ring of ticks")
    state = F64(CANDIDATES * 3, doc="model states: height [m] first")
    cov = F64(CANDIDATES * 6, doc="their covariances: 00 01 02 11 12 22")
    target_m = F64(CANDIDATES * TICKS, unit="m", doc="ring of set points per candidate")
    axis_z_m = F64(CANDIDATES, unit="m", doc="shadow axes")
    axis_v_mps = F64(CANDIDATES, unit="m/s")
    score_m2 = F64(CANDIDATES, unit="m^2", doc="recent squared stand-off error of the shadow")
    long_m2 = F64(CANDIDATES, unit="m^2", doc="the same over a longer way")
    effort = F64(CANDIDATES, unit="m^2/s^4", doc="recent squared acceleration of the set points")
    cost = F64(CANDIDATES, doc="what the weights are made of")
    weight = F64(CANDIDATES, doc="share of the candidate in the blend")
    height_m = F64(unit="m", doc="blended height at the last sample")
    slope = F64(unit="1", doc="blended slope there")
    sigma_m = F64(unit="m", doc="uncertainty of that height, spread of the models included")
    set_point_m = F64(unit="m", doc="set point of the tool after limits; where the demand points")
    set_speed_mps = F64(unit="m/s", doc="its rate of change")
    set_accel_mps2 = F64(unit="m/s^2", doc="and the rate of that")
    set_ns = I64(unit="ns", doc="when it was made; 0: never")
    own_m = F64(TICKS, unit="m", doc="ring of own set points")
    plant_z_m = F64(PLANTS, unit="m", doc="axes of different τ that follow them")
    plant_v_mps = F64(PLANTS, unit="m/s")
    plant_m2 = F64(PLANTS, unit="m^2", doc="their squared errors against the pose reports")
    axis_now_m = F64(unit="m", doc="own axis at `plant_ns`, with τ as found, kept near the reports")
    axis_now_mps = F64(unit="m/s")
    plant_ns = I64(unit="ns", doc="up to when they were carried")
    tau_s = F64(unit="s", doc="time constant of the robot's axis as found; 0: not begun")
    tau_assumed_s = F64(unit="s", doc="time constant that the search began with")
    cell_k = I64(CELLS, doc="which cell of the way this is, plus one")
    cell_n = F64(CELLS, doc="heights in its mean")
    cell_h_m = F64(CELLS, unit="m", doc="mean height")
    cell_s_m = F64(CELLS, unit="m", doc="mean way coordinate")
    preview_share = F64(doc="share of the planned set point, 0 to 1")
    preview_bias_m = F64(unit="m", doc="seen minus remembered ground")
    preview_off_m = F64(unit="m", doc="typical difference beyond that")
    plan_set_m = F64(unit="m", doc="set point of the plan")
    plan_g_m = F64(HORIZON, unit="m", doc="ground under the tool, tick by tick")
    plan_z_m = F64(HORIZON, unit="m", doc="planned axis")
    plan_u = F64(HORIZON, unit="m", doc="planned accelerations, in metres per tick²")
    plan_y = F64(HORIZON, unit="m", doc="their multipliers")
    band_0 = F64(HORIZON, doc="factors of the plan's matrix")
    band_1 = F64(HORIZON)
    band_2 = F64(HORIZON)
    trend_m = F64(TRENDS, unit="m", doc="range of each line")
    trend_mps = F64(TRENDS, unit="m/s", doc="its rate")
    trend_cov = F64(TRENDS * 3, doc="covariances 00 01 11, reading noise 1")
    trend_m2 = F64(LAGS * TRENDS, unit="m^2", doc="squared forecast errors by horizon")
    lag_s = F64(LAGS, unit="s", doc="those horizons")
    trend_ns = I64(unit="ns", doc="stamp of the last range; 0: none")
    trend_dt_s = F64(unit="s", doc="usual interval")
    trend_scale_m = F64(unit="m", doc="usual innovation")
    trend_odd = I64(doc="1: the last range was passed over")
    snap_m = F64(SNAPSHOTS * TRENDS, unit="m", doc="ring of earlier lines: range")
    snap_mps = F64(SNAPSHOTS * TRENDS, unit="m/s", doc="and rate")
    snap_ns = I64(SNAPSHOTS, unit="ns", doc="when that was")
    snapshots = I64(doc="taken so far")
    health = I64(doc="see HEALTH_NAMES")
    health_ns = I64(unit="ns", doc="since when the wanted health differs from the shown one")
    health_next = I64(doc="the wanted health")
    close_run = I64(doc="samples in a row near the fold-back")
    still = I64(doc="samples in a row of one value while the tool moved")
    still_z_m = F64(unit="m", doc="height of the tool where that began")
    faults = I64(doc="bits of FAULT_NAMES, latched until the reset")
