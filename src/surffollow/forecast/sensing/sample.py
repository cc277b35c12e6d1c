"""Sample hold and footprint: which reading is a new sample, where and when it was taken."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.pose import footprint, pose_at
from surffollow.forecast.scales import plain_time
from surffollow.shm.jit import jit

RATE = 0.05  # of learned intervals, spacings and delays
HOLD_INTERVALS = 1.5  # an unchanged reading counts as new after so many sample intervals …
HOLD_TAUS = 0.1  # … or time constants of the axis while the interval is not known
GAP_INTERVALS = 8.0  # a longer gap says nothing about the interval


@jit
def _learn(value: Any, seen: Any, count: Any) -> Any:
    """Running mean that begins with the plain mean."""
    return value + max(RATE, 1.0 / (count + 1)) * (seen - value)


@jit
def take_sample(params: Any, m: Any, sense: Any, pose: Any) -> None:
    """Turn a new reading of channel 0 into a sample; `pose` (7,) is scratch.

    A reading that repeats the one before is a held value until `HOLD_INTERVALS` have passed.
    """
    s, r, k = m.sample, m.reference, m.kinematics
    s.fresh = 0
    if sense.fresh[0] == 0:
        return
    t = plain_time(r, sense.range_t_ns[0])
    value = sense.range_m[0] / r.length_m
    if s.shift > 0.0 and k.now - t < s.delay + 0.5 * s.shift:
        s.shift = 0.0
    t += s.shift
    if s.count > 0:
        dt = t - s.t
        if dt <= 0.0:
            _doubt_timestamp(m, t)
            return
        hold = HOLD_INTERVALS * s.interval if s.interval > 0.0 else HOLD_TAUS * r.tau
        if value == s.range and dt < hold:
            return
    pose_at(sense, sense.range_t_ns[0] + int(s.shift * r.time_ns), 1, pose)
    x, y, z, _ = footprint(pose, params.tool_from_sensor, 0, sense.range_m[0])
    x, y, z = x / r.length_m, y / r.length_m, z / r.length_m
    if s.count > 0:
        s.dt = t - s.t
        if s.dt < GAP_INTERVALS * s.interval or s.interval == 0.0:
            s.interval = _learn(s.interval, s.dt, s.count - 1)
        s.way = k.speed * s.dt
    else:
        s.dt = s.way = 0.0
    s.delay = _learn(s.delay, max(k.now - t, 0.0), s.count)
    s.turn = 1.0
    if k.speed > 0.0:
        dx, dy = k.vx / k.speed, k.vy / k.speed
        if s.direction_x != 0.0 or s.direction_y != 0.0:
            s.turn = dx * s.direction_x + dy * s.direction_y
        s.direction_x, s.direction_y = dx, dy
        tool_x, tool_y = pose[0] / r.length_m, pose[1] / r.length_m
        lead = (x - tool_x - k.tip_x) * dx + (y - tool_y - k.tip_y) * dy
        s.lead = _learn(s.lead, lead, s.count)
        if s.way > 0.0 and (s.dt < GAP_INTERVALS * s.interval or s.spacing == 0.0):
            # a start from rest or a faster robot counts at once, a slower one bit by bit
            usual = k.speed * s.interval
            s.spacing = max(usual, s.spacing + RATE * (usual - s.spacing))
    s.range_2, s.range_1 = s.range_1, s.range
    s.fresh, s.t, s.range, s.height, s.x, s.y = 1, t, value, z, x, y
    s.count += 1
    s.backward = 0


@jit
def _doubt_timestamp(m: Any, t: Any) -> None:
    """Correct timestamps when several in a row lie before one that was there already.

    Readings that are late come in order. Those that go back have a wrong timestamp: until the delay is the
    usual one again they are taken to follow each other at the usual interval.
    """
    s = m.sample
    s.backward += 1 if t < s.t else 0
    if s.backward >= m.tuning.gate_confirm:
        s.shift += s.t + s.backward * s.interval - t
        s.backward = 0


@jit
def distance_ahead(m: Any, t: Any) -> Any:
    """How far ahead of the last footprint the point under the tool will be at a time."""
    s, k = m.sample, m.kinematics
    if k.speed == 0.0:
        return 0.0
    gap = (k.x + k.tip_x - s.x) * k.vx + (k.y + k.tip_y - s.y) * k.vy
    return gap / k.speed + k.speed * (t - k.pose_t)


@jit
def reaction_time(m: Any) -> Any:
    """Time between a reading's timestamp and the axis' answer: delay, controller period, time constant."""
    return m.sample.delay + 0.5 * m.sample.interval + control_delay(m) + m.plant.tau


@jit
def control_delay(m: Any) -> Any:
    """Mean time that a demand is in force before the next one: half a controller period.

    The controller is taken to report its pose once per period.
    """
    return 0.5 * min(m.kinematics.interval, 0.5 * m.plant.tau)


@jit
def is_leading(m: Any) -> Any:
    """1 when the sensor sees the ground before the tool is over it by more than the axis answers to."""
    return 1 if m.sample.lead > 0.5 * m.kinematics.speed * m.plant.tau + 0.01 * m.reference.standoff else 0


@jit
def reset_sampling(m: Any, scales: Any) -> None:
    """Forget the last sample; intervals, spacing and delay too when the reference scales changed."""
    s = m.sample
    s.fresh = 0
    s.direction_x = s.direction_y = s.shift = 0.0
    s.backward = 0
    if scales != 0:
        s.count = 0
        s.t = s.interval = s.spacing = s.delay = s.lead = s.range = s.range_1 = 0.0
