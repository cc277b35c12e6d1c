"""The paper's follower once more, slow and obvious: lists, dictionaries, float64, one thought per line.

Written from the specification (§3-4), not from the kernels. Where bits are compared the order of the
arithmetic is part of the definition and stands here: sums run from the oldest to the newest, a running
mean is (mean * n + new) / (n + 1), the way between two ranges is the mean of the ways between their
corresponding intervals, a vector v is turned by v + 2 q × (q × v + w v).
"""

from __future__ import annotations

import math

RING = 1024
POSES_KEPT = 256
ABSENT_NS = 10_000_000
BRANCH_TEST_M = 0.002
PROBE_M = 0.001


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def turned(q, v):
    """The vector v turned by the unit quaternion q = (x, y, z, w)."""
    axis, w = q[:3], q[3]
    c = cross(axis, v)
    t = tuple(c[i] + w * v[i] for i in range(3))
    d = cross(axis, t)
    return tuple(v[i] + 2.0 * d[i] for i in range(3))


def total(values):
    """Plain left-to-right sum (the built-in one compensates its rounding in newer Pythons)."""
    s = 0.0
    for v in values:
        s += v
    return s


def interpolated_pose(history, t_ns):
    """The pose at t_ns between its neighbours in [(t_ns, pose), ...]; the nearest end outside."""
    if t_ns >= history[-1][0]:
        return list(history[-1][1])
    before = [k for k, (t, _) in enumerate(history) if t <= t_ns]
    if not before:
        return list(history[0][1])
    (t0, a), (t1, b) = history[before[-1]], history[before[-1] + 1]
    w = (t_ns - t0) / (t1 - t0)
    sign = 1.0 if total(a[i] * b[i] for i in range(3, 7)) >= 0.0 else -1.0
    position = [a[i] * (1.0 - w) + b[i] * w for i in range(3)]
    q = [a[i] * (1.0 - w) + sign * b[i] * w for i in range(3, 7)]
    scale = 1.0 / math.sqrt(total(c * c for c in q))
    return position + [c * scale for c in q]


def sensor_and_footprint(tool, mount, range_m):
    """Where the sensor's face is, and where its beam (-z) ends, in the world."""
    arm = turned(tool[3:], mount[:3])
    beam = turned(tool[3:], turned(mount[3:], (0.0, 0.0, -range_m)))
    face = [tool[i] + arm[i] for i in range(3)]
    return face, [face[i] + beam[i] for i in range(3)]


class Interval:
    def __init__(self, x, y, h):
        self.x, self.y, self.height, self.n = x, y, h, 1
        self.members = [h]

    def average_in(self, h):
        self.height = (self.height * self.n + h) / (self.n + 1)
        self.n += 1
        self.members.append(h)


class NaiveIntervals:
    """Intervals along the path; `opened` counts all ever opened."""

    def __init__(self):
        self.ring, self.opened = [], 0

    def open(self, x, y, h):
        self.ring = [*self.ring, Interval(x, y, h)][-RING:]
        self.opened += 1

    def add(self, x, y, h, size):
        before = self.opened
        if not self.ring:
            self.open(x, y, h)
            return 1
        current = self.ring[-1]
        cx, cy, ch = current.x, current.y, current.height
        distance = math.sqrt((x - cx) * (x - cx) + (y - cy) * (y - cy))
        if distance <= size:
            current.average_in(h)
        elif distance <= 2.0 * size:
            self.open(x, y, h)
        else:
            steps = distance / size
            whole = math.floor(steps)
            for k in range(max(1, whole - RING + 1), whole + 1):
                part = k / steps
                self.open(cx + (x - cx) * part, cy + (y - cy) * part, ch + (h - ch) * part)
            self.ring[-1].average_in(h)
        return self.opened - before

    def two_ranges(self, size):
        """The range before the current one and the current one, or None while both are not full."""
        if len(self.ring) < 2 * size:
            return None
        newest = self.ring[len(self.ring) - 2 * size :]
        return newest[:size], newest[size:]

    def slope(self, size):
        ranges = self.two_ranges(size)
        if ranges is None:
            return 0.0
        previous, current = ranges
        way_x = total(b.x - a.x for a, b in zip(previous, current))
        way_y = total(b.y - a.y for a, b in zip(previous, current))
        way = math.sqrt(way_x * way_x + way_y * way_y) / size
        if way <= 0.0:
            return 0.0
        heights = [total(i.height for i in r) / size for r in (previous, current)]
        return (heights[1] - heights[0]) / way


class NaiveFollower:
    """`params`: name → value as in `Params`; per-channel ones are lists, mounts a list of poses."""

    def __init__(self, params):
        self.params = dict(params)
        n = 8
        self.windows = [[] for _ in range(n)]
        self.range_m, self.range_t_ns, self.valid = [0.0] * n, [0] * n, [False] * n
        self.poses, self.pose_number, self.refused = [], 0, 0
        self.close, self.close_z, self.close_range = False, 0.0, 0.0
        self.cycle = 0
        self.forget()

    def forget(self):
        """What SFReset clears."""
        self.points = [[] for _ in range(8)]
        self.intervals = NaiveIntervals()
        self.slope, self.speed = 0.0, 0.0
        self.speed_from = None  # (pose number, stamp, x, y)
        self.reading = None  # (cycle time, distance, sensor height)
        self.relayed = 0.0

    def reset(self, offset_m):
        self.params["offset_m"] = offset_m
        self.forget()

    def pose(self, t_ns, pose):
        if self.poses and t_ns <= self.poses[-1][0]:
            self.refused += 1
            return
        self.poses = [*self.poses, (t_ns, list(pose))][-POSES_KEPT:]
        self.pose_number += 1

    # -- sensor smoothing

    def take_conversions(self, t_ns, conversions):
        p, fresh = self.params, set()
        for dt_ns, c, flags, counts in conversions:
            if c >= p["n_channels"]:
                continue
            distance = p["zero_m"][c] + p["scale_m"][c] * counts
            if flags & 1 or not p["range_min_m"] < distance < p["range_max_m"]:
                self.windows[c], self.valid[c] = [], False
                fresh.discard(c)
            else:
                self.windows[c] = [*self.windows[c], (t_ns + dt_ns, distance)][-64:]
                fresh.add(c)
        wanted = p["sensor_readings"]
        for c in list(fresh):
            if len(self.windows[c]) < wanted:
                fresh.discard(c)
                continue
            last = self.windows[c][-wanted:]
            self.range_m[c] = total(d for _, d in last) / wanted
            middle = last[0][0] + (last[-1][0] - last[0][0]) // 2
            self.range_t_ns[c] = middle - p["sensor_latency_ns"]
            self.valid[c] = True
        return fresh

    def take_ranges(self, t_ns, ranges):
        p, fresh = self.params, set()
        self.valid = [False] * len(self.valid)
        for c, distance in enumerate(ranges[: p["n_channels"]]):
            self.valid[c] = p["range_min_m"] < distance < p["range_max_m"]
            if self.valid[c]:
                self.range_m[c], self.range_t_ns[c] = distance, t_ns - p["sensor_latency_ns"]
                fresh.add(c)
        return fresh

    def told(self, c, t_ns, fresh):
        """The distance of a channel, or None when there is none or the last one came too long ago."""
        came_ns = self.range_t_ns[c] + self.params["sensor_latency_ns"]
        if self.valid[c] and (c in fresh or t_ns - came_ns <= self.params["loss_timeout_ns"]):
            return self.range_m[c]
        return None

    # -- one cycle

    def step(self, t_ns, conversions=(), ranges=None, given_t_ns=0):
        fresh = (
            self.take_conversions(t_ns, conversions)
            if ranges is None
            else self.take_ranges(given_t_ns, ranges)
        )
        p = self.params
        out = {"status": set(), "dz": 0.0, "fresh": set(), "targets": {}, "delta_h": 0.0, "error": 0.0}
        if not self.poses:
            out["status"] = {"NO_POSE"}
        elif abs(t_ns - self.poses[-1][0]) > p["pose_timeout_ns"]:
            out["status"] = {"POSE_STALE"}
        else:
            self.follow(t_ns, fresh, out)
        if p["run"] == 1:
            out["status"] = (out["status"] - {"VALID"}) | {"DRYRUN"}
        elif p["run"] == 2:
            out["status"] = (out["status"] - {"VALID"}) | {"FROZEN"}
            out["dz"] = 0.0
        out["cycle"] = self.cycle
        out["range_m"] = [self.told(c, t_ns, fresh) for c in range(8)]
        out["slope"], out["speed"], out["intervals"] = self.slope, self.speed, self.intervals.opened
        self.cycle += 1
        return out

    def target_point(self, c):
        """Footprint of a channel's reading, averaged over the channel's last EE_Readings footprints."""
        p = self.params
        tool = (
            interpolated_pose(self.poses, self.range_t_ns[c]) if p["pose_interpolate"] else self.poses[-1][1]
        )
        face, point = sensor_and_footprint(tool, p["tool_from_sensor"][c], self.range_m[c])
        self.points[c] = [*self.points[c], point][-64:]
        last = self.points[c][-p["ee_readings"] :]
        return face[2], [total(q[i] for q in last) / len(last) for i in range(3)]

    def follow(self, t_ns, fresh, out):
        p = self.params
        out["fresh"] = fresh
        heights = {}
        for c in sorted(fresh):
            heights[c], out["targets"][c] = self.target_point(c)
        if 0 in fresh:
            sensor_z = heights[0]
            x, y, h = out["targets"][0]
            self.intervals.add(x, y, h, p["interval_size_m"])
            self.slope = self.intervals.slope(p["range_size"])
            self.measure_speed(x, y)
            self.watch_fold_back(sensor_z)
        else:
            face, _ = sensor_and_footprint(self.poses[-1][1], p["tool_from_sensor"][0], 0.0)
            sensor_z = face[2]
        delta_h, error = self.forecast(t_ns, 0 in fresh, sensor_z)
        out["delta_h"], out["error"] = delta_h, error
        status = {"VALID"}
        age = None if self.reading is None else t_ns - self.reading[0]
        if 0 not in fresh and (not self.valid[0] or age is None or age > ABSENT_NS):
            status.add("NO_SENSOR")
        wanted = delta_h + error
        cut = max(-p["max_demand_m"], min(p["max_demand_m"], wanted))
        if cut != wanted:
            status.add("LIMITED")
        if abs(cut - self.relayed) > p["permitted_variance_m"]:
            self.relayed = cut
        # a limit that was lowered holds for what was relayed before, too
        dz = max(-p["max_demand_m"], min(p["max_demand_m"], self.relayed))
        lost = age is None or age > p["loss_timeout_ns"]
        if lost:
            status = (status - {"VALID", "LIMITED"}) | {"SENSOR_LOST"}
            dz = 0.0
        if self.close:
            status.add("TOO_CLOSE")
            if not lost:
                dz = max(dz, min(PROBE_M, p["max_demand_m"]))
        out["status"], out["dz"] = status, dz

    def measure_speed(self, x, y):
        """Lateral speed of the footprint between successive pose updates."""
        number, stamp = self.pose_number, self.poses[-1][0]
        if self.speed_from is not None:
            if self.speed_from[0] == number:
                return
            _, t0, x0, y0 = self.speed_from
            way = math.sqrt((x - x0) * (x - x0) + (y - y0) * (y - y0))
            self.speed = way / ((stamp - t0) * 1e-9)
        self.speed_from = (number, stamp, x, y)

    def forecast(self, t_ns, fresh, sensor_z):
        """ΔH since the last reading, and desired minus actual offset."""
        if self.reading is None and not fresh:
            return 0.0, 0.0
        elapsed_s = 0.0 if self.reading is None else (t_ns - self.reading[0]) * 1e-9
        delta_h = self.slope * self.speed * elapsed_s
        if fresh:
            self.reading = (t_ns, self.range_m[0], sensor_z)
            return delta_h, self.params["offset_m"] - self.range_m[0]
        # the tool's own motion since is known, and no part of the surface's
        _, distance, z = self.reading
        return delta_h, self.params["offset_m"] - (distance + sensor_z - z)

    def watch_fold_back(self, sensor_z):
        """TOO_CLOSE begins near the near limit and ends when the reading rises with the tool, far enough."""
        p, distance = self.params, self.range_m[0]
        if not self.close:
            if distance < p["too_close_m"]:
                self.close, self.close_z, self.close_range = True, sensor_z, distance
            return
        rise = sensor_z - self.close_z
        if abs(rise) < BRANCH_TEST_M:
            return
        follows = (distance - self.close_range) * rise > 0.5 * rise * rise
        if follows and distance > p["too_close_exit_m"]:
            self.close = False
        self.close_z, self.close_range = sensor_z, distance
