"""The kernel that steps the follower over logged words and keeps samples."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.step import follow_step
from surffollow.record.log_kernels import entry_length
from surffollow.shm.jit import jit
from surffollow.shm.journal import (
    CYCLE,
    decode_cycle,
    entry_kind,
    same_outcome,
)
from surffollow.shm.layout_follow import CHANNELS, POSES, Output
from surffollow.shm.schema import F64, I64, Nested, Schema


class Sample(Schema):
    """One cycle's outcome, and the pose that its demand adds to."""

    output = Nested(Output)
    pose = F64(7, unit="m, 1", doc="newest pose reported: x y z qx qy qz qw, world from tool")
    pose_delay_ns = I64(unit="ns", doc="how old that pose was when it arrived; -1: none arrived yet")
    seen = I64(doc="bit per channel: `target_m` is newer than the sample before")
    points = I64(doc="target points of this run up to and with this cycle")


SAMPLE_WORDS = Sample.SIZE // 8
_OUTPUT_WORDS = Output.SIZE // 8
_DEMAND_WORD = Output.offset("demand") // 8
_POSE_WORD = Sample.offset("pose") // 8
_DELAY_WORD = Sample.offset("pose_delay_ns") // 8
_SEEN_WORD = Sample.offset("seen") // 8
_POINTS_WORD = Sample.offset("points") // 8
# plan: when the next sample is due, its period (0: every cycle), 1: a snapshot was loaded, cycles that came
# out otherwise than logged, delay of the newest pose, channels seen since the last sample
NEXT, PERIOD, STARTED, DIFFERING, DELAY, SEEN, PLAN = 0, 1, 2, 3, 4, 5, 6


@jit
def step_samples(
    words: Any,
    floats: Any,
    begin: Any,
    records: Any,
    views: Any,
    scratch: Any,
    plan: Any,
    kept: Any,
    out: Any,
) -> None:
    """Step over CYCLE entries from `begin` on and keep samples and target points.

    Ends at the end, before an entry of another kind, when a buffer is full, or at a word that begins no
    entry.

    Parameters
    ----------
    words, floats : (n,) int64, float64     the same memory
    begin : int64
    records : (params, state, inputs, output), views : (output,) as int64 words
    scratch : (7,) float64
    plan : (6,) int64                       updated
    kept : (rows (r, SAMPLE_WORDS) int64, the same as float64, points (p, 3) float64 [m])
    out : (3,) int64                        where it ended, rows kept, points kept
    """
    params, state, inputs, output = records
    output_words = views[0]
    rows, row_floats, points = kept
    at, n_rows, n_points = begin, 0, 0
    while at < words.size and n_rows < rows.shape[0] and n_points + CHANNELS <= points.shape[0]:
        length = entry_length(words[at])
        if length == 0 or at + length > words.size or entry_kind(words[at]) != CYCLE:
            break
        if decode_cycle(words, floats, at, inputs) != length:
            break
        i, o, s = inputs[0], output[0], state[0].sense
        follow_step(params, state, inputs, output, scratch)
        if same_outcome(words, at, output_words, _DEMAND_WORD, o.status, o.cycle) == 0:
            plan[DIFFERING] += 1
        if i.n_poses > 0:
            plan[DELAY] = i.t_ns - i.pose_t_ns[i.n_poses - 1]
        plan[SEEN] |= o.fresh
        for c in range(params[0].n_channels):
            if (o.fresh >> c) & 1 != 0:
                for k in range(3):
                    points[n_points, k] = o.target_m[3 * c + k]
                n_points += 1
        if o.t_ns >= plan[NEXT]:
            if plan[PERIOD] > 0:
                plan[NEXT] = (o.t_ns // plan[PERIOD] + 1) * plan[PERIOD]
            for k in range(_OUTPUT_WORDS):
                rows[n_rows, k] = output_words[k]
            newest = (s.pose_count - 1) & (POSES - 1)
            for k in range(7):
                row_floats[n_rows, _POSE_WORD + k] = s.pose[7 * newest + k]
            rows[n_rows, _DELAY_WORD] = plan[DELAY]
            rows[n_rows, _SEEN_WORD], plan[SEEN] = plan[SEEN], 0
            rows[n_rows, _POINTS_WORD] = n_points
            n_rows += 1
        at += length
    out[0], out[1], out[2] = at, n_rows, n_points
