"""Sum the commands of several resources into one, relative to one reported pose (spec §1; paper 000 §3).

The first part that is held and relative to a pose gives the pose; the others are converted to it. The
sum is valid only while every part that is held is, every part that is required is held, and no part is lost:
without the lift of a client that died, the rest would lead the tool down. A converted part counts within its
own limits. Poses farther apart than the parts can lead contradict each other: there is no sum.
"""

from __future__ import annotations

import math
from typing import Any

import surffollow.arbiter.layout as al
from surffollow.arbiter.publish import put_command, set_apart
from surffollow.arbiter.table import FREE
from surffollow.shm.jit import jit

_VALUES, _SOURCE_SAFE, _SOURCE_COMBINED = al.VALUES, al.SOURCE_SAFE, al.SOURCE_COMBINED
UNIT_TOLERANCE = 1e-3  # of the square of a quaternion's norm


@jit
def multiply(a: Any, b: Any, out: Any) -> None:
    """Product of two quaternions (x, y, z, w): first `b`, then `a`."""
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    out[2] = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]


@jit
def to_pose(value: Any, from_pose: Any, to: Any, n: Any, scratch: Any, out: Any) -> None:
    """Express a demand that was relative to one reported pose relative to another.

    Parameters
    ----------
    value : (8,) float64        x y z [m], rotation vector [rad], world axes
    from_pose, to : (7,) float64   x y z [m], qx qy qz qw, world from tool
    n : int64                   values that count: 6, or 3 and no rotation
    scratch : (12,) float64
    out : (8,) float64          written

    Notes
    -----
    The place and attitude asked for stay: p1 + d1 = p0 + d0 and exp(r1) q1 = exp(r0) q0.
    """
    for k in range(len(out)):
        out[k] = value[k]
    for k in range(min(n, 3)):
        out[k] = value[k] + from_pose[k] - to[k]
    if n < 6:
        return
    angle = math.sqrt(value[3] ** 2 + value[4] ** 2 + value[5] ** 2)
    part = 0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle
    turn, there, back = scratch[0:4], scratch[4:8], scratch[8:12]
    for k in range(3):
        turn[k] = part * value[3 + k]
        back[k] = -to[3 + k]
    turn[3], back[3] = math.cos(0.5 * angle), to[6]
    multiply(turn, from_pose[3:7], there)
    multiply(there, back, turn)
    if turn[3] < 0.0:  # the short way round
        for k in range(4):
            turn[k] = -turn[k]
    sine = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    part = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, turn[3]) / sine
    for k in range(3):
        out[3 + k] = part * turn[k]


@jit
def is_pose(pose: Any) -> Any:
    """Whether seven finite numbers are a pose: the last four a unit quaternion. A client may give none."""
    return abs(pose[3] ** 2 + pose[4] ** 2 + pose[5] ** 2 + pose[6] ** 2 - 1.0) < UNIT_TOLERANCE


@jit
def turn_between(one: Any, other: Any, scratch: Any) -> Any:
    """Angle [rad] between two attitudes.

    Parameters
    ----------
    one, other : (4,) float64  quaternions x y z w
    scratch : (8,) float64
    """
    back, turn = scratch[0:4], scratch[4:8]
    for k in range(3):
        back[k] = -other[k]
    back[3] = other[3]
    multiply(one, back, turn)
    return 2.0 * math.atan2(math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2), abs(turn[3]))


@jit
def can_convert(x: Any, from_pose: Any, to: Any, scratch: Any) -> Any:
    """Whether a command relative to one pose may be summed relative to another.

    Parameters
    ----------
    x : record of `CombinationRun`
    from_pose, to : (7,) float64  x y z [m], qx qy qz qw; all zero: not given
    scratch : (8,) float64
    """
    if x.converts == 0 or not (is_pose(from_pose) and is_pose(to)):
        return False
    square = 0.0
    for k in range(3):
        square += (from_pose[k] - to[k]) ** 2
    if math.sqrt(square) > x.reach_m:
        return False
    return x.n_values < 6 or turn_between(from_pose[3:7], to[3:7], scratch) <= x.reach_rad


@jit
def differs(x: Any, run: Any, of: Any) -> Any:
    """Whether a command is relative to another pose than the sum: by its time, or by its values.

    One report has one pose: where two clients give it differently, one of them is wrong. A client that gives
    the time alone means the pose of that report.

    Parameters
    ----------
    x : record of `CombinationRun`
    run, of : record of `ResourceRun`  the part, and the one whose pose the sum has
    """
    if run.ref_t_ns != of.ref_t_ns:
        return True
    if x.converts == 0 or not (is_pose(run.ref_pose) and is_pose(of.ref_pose)):
        return False
    same = True
    for k in range(len(run.ref_pose)):
        same = same and run.ref_pose[k] == of.ref_pose[k]
    return not same


@jit
def add_parts(mem: Any, combination: Any, t_ns: Any) -> Any:
    """Sum the parts into `mem.slot`; 1: valid, 0: not. Its times and the pose are filled in, too.

    The sum is as old as the oldest command in it.

    Parts that name two poses, one of which was not given or is too far from the other, make no sum.
    """
    x, c = mem.combinations[combination], mem.slot[0].command
    reference, held, valid, until, oldest = -1, 0, 1, t_ns + x.ttl_ns, t_ns
    x.apart = -1
    c.ref_t_ns = 0
    for k in range(_VALUES):
        c.value[k] = c.safe[k] = 0.0
    for i in range(x.n_parts):
        r = x.part[i]
        run = mem.runs[r]
        if mem.machines[r].state == FREE:
            valid = 0 if x.required[i] != 0 or run.lost_ns > 0 else valid
            continue
        held += 1
        if t_ns >= run.valid_until_ns:
            return 0
        until, oldest = min(until, run.valid_until_ns), min(oldest, run.command_ns)
        if run.ref_t_ns != 0 and reference < 0:
            reference = r
            c.ref_t_ns = run.ref_t_ns
    c.valid_until_ns = until
    if held == 0 or valid == 0:
        return 0
    c.t_ns = oldest
    for i in range(x.n_parts):
        r = x.part[i]
        run = mem.runs[r]
        if mem.machines[r].state == FREE:
            continue
        if reference >= 0 and run.ref_t_ns != 0 and differs(x, run, mem.runs[reference]):
            to = mem.runs[reference].ref_pose
            if not can_convert(x, run.ref_pose, to, mem.scratch[0:8]):
                x.apart = r
                return 0
            to_pose(run.value, run.ref_pose, to, x.n_values, mem.scratch[0:12], mem.scratch[12:20])
            for k in range(x.n_values):
                converted = mem.scratch[12 + k]
                if not math.isfinite(converted):
                    return 0
                value = min(max(converted, run.low[k]), run.high[k])
                if value != converted:
                    c.flags |= al.FLAG_LIMITED
                c.value[k] += value
        else:
            for k in range(_VALUES):
                c.value[k] += run.value[k]
    for k in range(_VALUES):
        if not math.isfinite(c.value[k]):
            return 0  # huge numbers may overflow in a sum though each is finite
    return 1


@jit
def publish_combination(mem: Any, combination: Any, t_ns: Any) -> None:
    """Publish the sum when a part changed, and what is safe (no demand at all) when it is due."""
    x, c = mem.combinations[combination], mem.slot[0].command
    over = x.source == _SOURCE_COMBINED and t_ns >= x.valid_until_ns
    if x.changed == 0 and not over and (x.source == _SOURCE_COMBINED or t_ns - x.published_ns < x.period_ns):
        return
    x.changed = 0
    c.flags, c.client, c.token, c.n_values, c.t_ns = 0, 0, 0, x.n_values, t_ns
    if add_parts(mem, combination, t_ns) != 0:
        x.source = _SOURCE_COMBINED
        for k in range(x.n_values):
            value = min(max(c.value[k], x.low[k]), x.high[k])
            if value != c.value[k]:
                c.flags |= al.FLAG_LIMITED
                c.value[k] = value
        x.valid_until_ns = c.valid_until_ns
    else:
        x.source = _SOURCE_SAFE
        c.flags = 0
        c.t_ns, c.ref_t_ns, c.valid_until_ns = t_ns, 0, t_ns + 3 * x.period_ns
        for k in range(_VALUES):
            c.value[k] = 0.0
    for i in range(x.n_parts):
        r = x.part[i]
        since_ns = mem.runs[r].apart_ns
        set_apart(mem, r, 0 if r != x.apart else since_ns if since_ns > 0 else t_ns)
    x.command_seq += 1
    x.published_ns = t_ns
    c.seq, c.source = x.command_seq, x.source
    put_command(mem, x.block, x.fence, t_ns)
