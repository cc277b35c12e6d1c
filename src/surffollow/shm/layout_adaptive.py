"""What the adaptive follower remembers: path, candidate models with their shadow axes, quarantine, noise."""

from __future__ import annotations

from surffollow.shm.schema import F64, I64, Schema

CANDIDATES = 64  # most models in the bank
TICKS = 64  # controller ticks remembered per candidate: 640 ms of set points
RECENT = 8  # quarantined samples remembered


class AdaptiveState(Schema):
    """State of the adaptive mode; all zero means nothing seen yet."""

    now_ns = I64(unit="ns", doc="latest time any step was told")
    sample_ns = I64(unit="ns", doc="stamp of the last sample taken; 0: none yet")
    accepted_ns = I64(unit="ns", doc="stamp of the last sample that entered the estimate")
    samples = I64(doc="samples that entered the estimate")
    path_m = F64(unit="m", doc="way travelled up to the last accepted sample")
    speed_x_mps = F64(unit="m/s", doc="lateral velocity of the tool")
    speed_y_mps = F64(unit="m/s")
    speed_mps = F64(unit="m/s")
    scale_m = F64(unit="m", doc="typical one-step innovation of the blend")
    noise_m = F64(unit="m", doc="reading noise from second differences")
    recent_m = F64(2, unit="m", doc="the two accepted heights before the last one")
    median_m = F64(unit="m", doc="running median of |second difference|")
    quarantined = I64(doc="samples in quarantine that agree")
    quarantine_m = F64(unit="m", doc="mean height of those")
    quarantine_shift_m = F64(unit="m", doc="mean innovation of those")
    quarantine_way_m = F64(unit="m", doc="way since the first of those")
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
    cost_m2 = F64(CANDIDATES, unit="m^2", doc="what the weights are made of")
    weight = F64(CANDIDATES, doc="share of the candidate in the blend")
    height_m = F64(unit="m", doc="blended height at the last sample")
    slope = F64(unit="1", doc="blended slope there")
    set_point_m = F64(unit="m", doc="blended set point of the tool")
