"""The baseline controllers that a follower is compared with, compiled together with their run.

All get the same data: readings with their timestamps, poses interpolated to those timestamps. A method is
two functions, one for a reading and one for a controller period, on a parameter row and its buffers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark import wave_filter as waves
from surffollow.benchmark.height_filters import (
    COUNT,
    CURSOR,
    ERROR,
    INTEGRAL,
    KEPT,
    PENDING,
    REFUSED,
    SEEN,
    STAMP,
    STATE_SIZE,
    TAKEN,
    TARGET,
    TRACK_COLUMNS,
    X,
    height_at,
    update_kalman,
    update_low_pass,
    update_waves,
)
from surffollow.benchmark.local_line import smoothed
from surffollow.benchmark.loop import END, SAMPLE, STEP_S, TICK, World, advance
from surffollow.benchmark.preview_planner import setpoint
from surffollow.benchmark.preview_programme import PERIODS, new_planner, reference
from surffollow.benchmark.reported_motion import lateral_speed, pose_at
from surffollow.shm.jit import jit

HOLD, P, PI, LPF_GATE, KALMAN_FF, KALMAN_WAVE, KALMAN_ADAPTIVE, PREVIEW = range(8)

READING_TIMEOUT_MS = 100.0  # p and pi act on no reading older than this …
READING_TIMEOUT_PERIODS = 3.0  # … or so many intervals of a slow sensor
INTEGRAL_LIMIT_M = 0.02
DROPOUT_AFTER_MS = 25.0  # no reading for so long beyond the sensor's latency: a drop-out, not a glitch
POLICY_EXTRAPOLATE, POLICY_HOLD = 0.0, 1.0


class Buffers(NamedTuple):
    """Memory of one baseline.

    Attributes
    ----------
    state : (`STATE_SIZE`,) float64
    track : (readings, `TRACK_COLUMNS`) float64, one estimate per reading
    memory, plan : what some kinds need beside, see `run_jitted`
    """

    state: NDArray[Any]
    track: NDArray[Any]
    memory: NDArray[Any]
    plan: NDArray[Any]


@jit
def _wave_target(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], f: NDArray[Any], s: Any, x_m: float, v_mps: float
) -> float:
    """Height for the tool: x is the place one lag ahead; a wave's part for the axis is τ · v · slope."""
    j = waves.selected(f)
    if j == waves.SLOPE_MODEL:
        return float(height_at(m, track, x_m))
    back = min(s.tau_s, p[4])
    here = x_m - v_mps * back
    if here < m[X]:
        return height_at(m, track, x_m) if x_m < m[X] else float(waves.height(f, j, x_m - m[X]))
    ahead = here - m[X]
    return float(waves.height(f, j, ahead) + back * v_mps * waves.slope(f, j, ahead))


@jit
def _keep_reading(m: NDArray[Any], seen: NDArray[Any], made: int, x_m: float, h_m: float) -> None:
    """Keep a reading for the preview planner; refused ones count when the filter is reset to them."""
    kept, pending = int(m[KEPT]), int(m[PENDING])
    at = kept if made == TAKEN else kept + pending
    if at < seen.shape[0]:
        seen[at, 0], seen[at, 1] = x_m, h_m
    if made == REFUSED:
        m[PENDING] = pending + 1
        return
    m[KEPT] = min(at + 1, seen.shape[0])
    m[PENDING] = 0.0


@jit
def _planned(p: NDArray[Any], buffers: Buffers, s: Any, w: World, x_m: float, v_mps: float) -> float:
    """Setpoint of the preview planner (p: as above, smoothing width [m], effort [s⁴]); x is that of now."""
    m, seen, g = buffers.state, buffers.memory, buffers.plan
    desired = reference(g)
    count = int(m[KEPT])
    cursor = int(m[CURSOR])
    step_m = v_mps * s.tick_ms * STEP_S
    for k in range(PERIODS):
        x = min(x_m + (k + 1) * step_m, m[X])  # behind the last reading: its height
        h, cursor = smoothed(seen, cursor, count, x, p[4])
        if k == 0:
            m[CURSOR] = cursor
        desired[k] = h + s.standoff_m
    last = w.reports[s.poses - 1]
    return float(setpoint(g, p[5], s.poses, float(last.ms), last.z, s))


@jit
def on_sample(kind: int, p: NDArray[Any], buffers: Buffers, s: Any, w: World) -> None:
    """Use the reading that has just arrived (index `samples` − 1).

    Parameters
    ----------
    kind : int             HOLD … PREVIEW
    p : (n,) float64       parameters of the baseline
    buffers : Buffers      updated
    s : record of the run  see `loop`
    w : World              what the run presents
    """
    m, track, memory = buffers.state, buffers.track, buffers.memory
    i = s.samples - 1
    r = w.readings[i].range
    if not math.isfinite(r):
        return
    stamp = w.readings[i].timestamp_ms
    dt_s = (stamp - m[STAMP]) * STEP_S if m[SEEN] > 0.0 else 0.0
    m[STAMP] = stamp
    m[SEEN] = 1.0
    m[ERROR] = r - s.standoff_m
    if kind < LPF_GATE:
        return
    x, z = pose_at(s, w, stamp)
    if not math.isfinite(z):
        return
    x, h = x + s.lead_m, z - r
    if kind == LPF_GATE:
        update_low_pass(p, m, track, dt_s, x, h)
    elif kind == KALMAN_WAVE:
        delay_s = (s.ms - stamp) * STEP_S
        ahead = max(lateral_speed(s, w) * (delay_s + p[4]) - s.lead_m, 0.0)
        update_waves(p, m, track, memory, x, h, ahead)
    elif kind == PREVIEW:
        _keep_reading(m, memory, update_kalman(p, m, track, x, h, 0.0), x, h)
    else:
        update_kalman(p, m, track, x, h, p[5] if kind == KALMAN_ADAPTIVE else 0.0)


@jit
def on_period(kind: int, p: NDArray[Any], buffers: Buffers, s: Any, w: World) -> float:
    """Demand [m] to be added to the newest report that has arrived; 0 before anything is known.

    Parameters
    ----------
    kind, p, buffers, s, w  as in `on_sample`
    """
    m, track, memory = buffers.state, buffers.track, buffers.memory
    if s.poses == 0:
        return 0.0
    z_report = w.reports[s.poses - 1].z
    if kind == HOLD:
        if m[COUNT] == 0.0:
            m[COUNT] = 1.0
            m[TARGET] = z_report
        return float(m[TARGET] - z_report)
    if m[SEEN] == 0.0:
        return 0.0
    if kind in (P, PI):
        timeout_ms = READING_TIMEOUT_MS
        if w.readings.shape[0] > 1:
            timeout_ms = max(
                timeout_ms,
                READING_TIMEOUT_PERIODS * (w.readings[1].timestamp_ms - w.readings[0].timestamp_ms),
            )
        if s.ms - m[STAMP] > timeout_ms + (w.readings[0].arrival_ms - w.readings[0].timestamp_ms):
            return 0.0
        if kind == P:
            return float(-p[0] * m[ERROR])
        m[INTEGRAL] -= p[1] * m[ERROR] * s.tick_ms * STEP_S
        m[INTEGRAL] = min(max(m[INTEGRAL], -INTEGRAL_LIMIT_M), INTEGRAL_LIMIT_M)
        return float(-p[0] * m[ERROR] + m[INTEGRAL])
    if m[COUNT] == 0.0:
        return 0.0
    ahead_s = (s.ms - w.reports[s.poses - 1].ms) * STEP_S
    v = lateral_speed(s, w)
    if kind == PREVIEW:
        return float(_planned(p, buffers, s, w, w.reports[s.poses - 1].x + v * ahead_s, v) - z_report)
    lag_s = p[2] if kind == LPF_GATE else p[4]
    x = w.reports[s.poses - 1].x + v * (ahead_s + lag_s)
    if kind == KALMAN_WAVE:
        return float(_wave_target(p, m, track, memory, s, x, v) + s.standoff_m - z_report)
    silent_ms = s.ms - m[STAMP] - (w.readings[0].arrival_ms - w.readings[0].timestamp_ms)
    if not (kind == KALMAN_FF and p[5] == POLICY_HOLD and silent_ms > DROPOUT_AFTER_MS):
        m[TARGET] = height_at(m, track, x) + s.standoff_m
    return float(m[TARGET] - z_report)


@jit
def run_baseline(kind: int, p: NDArray[Any], buffers: Buffers, s: Any, w: World) -> None:
    """Run one baseline to the end of the path.

    Parameters
    ----------
    kind, p : which, and its parameters
    buffers : its memory; the state is zeros
    s, w : a fresh run
    """
    while True:
        event = advance(s, w)
        if event == END:
            return
        if event == SAMPLE:
            on_sample(kind, p, buffers, s, w)
        elif event == TICK:
            s.demand_m = on_period(kind, p, buffers, s, w)


def run_jitted(kind: int, params: tuple[float, ...], s: Any, w: World) -> None:
    """Run one baseline with its parameters in a fresh run.

    Parameters
    ----------
    kind : int                 HOLD … PREVIEW
    params : floats            parameters of the baseline
    s : record of a fresh run  updated
    w : World                  what the run presents
    """
    count = max(1, len(w.readings))
    track = np.empty((count, TRACK_COLUMNS))
    memory = plan = np.empty((1, 1))
    if kind == KALMAN_WAVE:
        memory = waves.new_bank()
    elif kind == PREVIEW:
        memory, plan = np.empty((count, 2)), new_planner()
    run_baseline(kind, np.array(params, np.float64), Buffers(np.zeros(STATE_SIZE), track, memory, plan), s, w)
