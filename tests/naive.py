"""The paper's follower once more, slow and obvious: lists, dictionaries, float64, one thought per line.

Written from the specification (§3-4), not from the kernels. Where bits are compared the order of the
arithmetic is part of the definition and stands here: sums run from the oldest to the newest, a running
mean is (mean * n + new) / (n + 1), the run between two ranges is the mean over their corresponding
intervals of the distance along the path (pieces from the oldest to the newest, each times the number of
pairs it lies between), a vector v is turned by v + 2 q × (q × v + w v).
"""

from __future__ import annotations

import itertools
import math

RING = 1024
POSES_KEPT = 256
ABSENT_TAU = 0.25
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
        path = [*previous, *current]
        steps = [(b.x - a.x, b.y - a.y) for a, b in itertools.pairwise(path)]
        pieces = [math.sqrt(dx * dx + dy * dy) for dx, dy in steps]
        pairs_across = [len([i for i in range(size) if i <= k < i + size]) for k in range(len(pieces))]
        way = total(n * piece for n, piece in zip(pairs_across, pieces)) / size
        if way <= 0.0:
            return 0.0
        heights = [total(i.height for i in r) / size for r in (previous, current)]
        return (heights[1] - heights[0]) / way


class NaiveFollower:
    """`params`: name → value as in `Params`; per-channel ones are lists, mounts a list of poses."""

    def __init__(self, params):
        self.params = dict(params)
        self.absent_ns = ABSENT_TAU * 1e9 * params["plant_tau_s"]
        n = 8
        self.windows = [[] for _ in range(n)]
        self.last_sample_ns, self.spacing_ns = [None] * n, [0] * n
        self.steps_without = [0] * n  # since the last valid sample
        self.begin_anew = set()  # channels with a loss since their last target point
        self.range_m, self.range_t_ns, self.valid = [0.0] * n, [0] * n, [False] * n
        self.poses, self.pose_number, self.refused = [], 0, 0
        self.close, self.close_z, self.close_range = False, 0.0, 0.0
        self.cycle = 0
        self.forget()

    def forget(self):
        """Clear the state that SFReset clears."""
        self.points = [[] for _ in range(8)]  # per channel (stamp of the pose used, point)
        self.intervals = NaiveIntervals()
        self.slope, self.speed, self.heading = 0.0, 0.0, (0.0, 0.0)
        self.speed_from = None  # (pose number, mean stamp, x, y)
        self.reading = None  # (cycle time, distance, sensor height)
        self.relayed = None  # (demand, sensor height when it was relayed)

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

    def lose(self, c):
        """No mean and no speed may span what happened between the samples before and after."""
        self.windows[c], self.valid[c] = [], False
        self.begin_anew.add(c)

    def sample(self, c, t_ns, distance):
        if self.steps_without[c] and self.last_sample_ns[c] is not None:
            gap = t_ns - self.last_sample_ns[c]
            if gap > max(self.absent_ns, 2 * self.spacing_ns[c]):
                self.lose(c)
        self.steps_without[c] = 0
        self.windows[c] = [*self.windows[c], (t_ns, distance)][-64:]

    def in_range(self, distance):
        return self.params["range_min_m"] < distance < self.params["range_max_m"]

    def take_conversions(self, t_ns, conversions):
        p, sampled = self.params, set()
        for dt_ns, c, flags, counts in conversions:
            if c >= p["n_channels"]:
                continue
            distance = p["zero_m"][c] + p["scale_m"][c] * counts
            if flags & 1 or not self.in_range(distance):
                self.lose(c)
                sampled.discard(c)
            else:
                self.sample(c, t_ns + dt_ns, distance)
                sampled.add(c)
        return self.smooth(sampled)

    def take_ranges(self, t_ns, ranges):
        sampled = set()
        self.valid = [False] * len(self.valid)
        for c, distance in enumerate(ranges[: self.params["n_channels"]]):
            if self.in_range(distance):
                self.sample(c, t_ns, distance)
                sampled.add(c)
            elif not math.isnan(distance):
                self.lose(c)
        return self.smooth(sampled)

    def smooth(self, sampled):
        """The channels with a new reading: the mean of the last Sensor_Readings samples."""
        p, fresh = self.params, set()
        expected = p["sensor_readings"]
        for c in range(p["n_channels"]):
            if c not in sampled:
                self.steps_without[c] += 1
                continue
            newest = self.windows[c][-1][0]
            if self.last_sample_ns[c] is not None:
                gap, usual = newest - self.last_sample_ns[c], self.spacing_ns[c]
                if gap > 0:
                    self.spacing_ns[c] = usual + (gap - usual) // 8 if 0 < usual <= gap else gap
            self.last_sample_ns[c] = newest
            last = self.windows[c][-expected:]
            if len(last) < expected:
                continue
            self.range_m[c] = total(d for _, d in last) / expected
            middle = last[0][0] + (newest - last[0][0]) // 2
            self.range_t_ns[c] = middle - p["sensor_latency_ns"]
            self.valid[c] = True
            fresh.add(c)
        return fresh

    def reported(self, c, t_ns, fresh):
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
            self.begin_anew = set(range(8))
        else:
            self.follow(t_ns, fresh, out)
        if p["run"] == 1:
            out["status"] = (out["status"] - {"VALID"}) | {"DRYRUN"}
        elif p["run"] == 2:
            out["status"] = (out["status"] - {"VALID"}) | {"FROZEN"}
            out["dz"] = 0.0
        out["cycle"] = self.cycle
        out["range_m"] = [self.reported(c, t_ns, fresh) for c in range(8)]
        out["slope"], out["speed"], out["intervals"] = self.slope, self.speed, self.intervals.opened
        self.cycle += 1
        return out

    def target_point(self, c):
        """Sensor height, mean of the channel's last EE_Readings footprints, and the point for the map.

        The map gets the footprint itself where the mean lies farther than Interval_Size from all in it.
        """
        p = self.params
        if c in self.begin_anew:
            self.begin_anew.discard(c)
            self.points[c] = []
            if c == 0:
                self.speed_from = self.reading = None
        tool, stamp = self.poses[-1][1], self.poses[-1][0]
        if p["pose_interpolate"]:
            tool = interpolated_pose(self.poses, self.range_t_ns[c])
            stamp = sorted([self.poses[0][0], self.range_t_ns[c], stamp])[1]
        face, point = sensor_and_footprint(tool, p["tool_from_sensor"][c], self.range_m[c])
        self.points[c] = [*self.points[c], (stamp, point)][-64:]
        last = [q for _, q in self.points[c][-p["ee_readings"] :]]
        mean = [total(q[i] for q in last) / len(last) for i in range(3)] if len(last) > 1 else point
        near = [(mean[0] - q[0]) ** 2 + (mean[1] - q[1]) ** 2 <= p["interval_size_m"] ** 2 for q in last]
        return face[2], mean, mean if any(near) else point

    def follow(self, t_ns, fresh, out):
        p = self.params
        out["fresh"] = fresh
        means, heights = {}, {}
        for c in sorted(fresh):
            heights[c], means[c], out["targets"][c] = self.target_point(c)
        face, _ = sensor_and_footprint(self.poses[-1][1], p["tool_from_sensor"][0], 0.0)
        sensor_z = face[2]
        if 0 in fresh:
            x, y, h = means[0]
            self.intervals.add(x, y, h, p["interval_size_m"])
            self.slope = self.intervals.slope(p["range_size"])
            self.measure_speed(x, y)
            self.watch_fold_back(heights[0])
        delta_h, error = self.forecast(t_ns, heights.get(0), sensor_z)
        out["delta_h"], out["error"] = delta_h, error
        status = {"VALID"}
        age = None if self.reading is None else t_ns - self.reading[0]
        if 0 not in fresh and (not self.valid[0] or age is None or age > self.absent_ns):
            status.add("NO_SENSOR")
        expected = delta_h + error
        cut = max(-p["max_demand_m"], min(p["max_demand_m"], expected))
        if cut != expected:
            status.add("LIMITED")
        # the limit holds for what was relayed before, too
        dz = max(-p["max_demand_m"], min(p["max_demand_m"], self.relay(cut, sensor_z)))
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
        """Lateral speed of the mean footprint between successive pose updates, over its own mean time."""
        number = self.pose_number
        if self.speed_from is not None and self.speed_from[0] == number:
            return
        stamps = [s for s, _ in self.points[0][-self.params["ee_readings"] :]]
        stamp = stamps[-1] - sum(stamps[-1] - s for s in stamps) // len(stamps)
        if self.speed_from is not None:
            _, t0, x0, y0 = self.speed_from
            way = math.sqrt((x - x0) * (x - x0) + (y - y0) * (y - y0))
            if stamp > t0:
                self.speed = way / ((stamp - t0) * 1e-9)
        self.speed_from = (number, stamp, x, y)

    def relay(self, demand, sensor_z):
        """Nothing new until the demand changes by more than Permitted_Variance: go where sent."""
        if self.relayed is None:
            self.relayed = (0.0, sensor_z)
        before, z = self.relayed
        kept = before - (sensor_z - z)
        if abs(demand - kept) <= self.params["permitted_variance_m"]:
            return kept
        self.relayed = (demand, sensor_z)
        return demand

    def forecast(self, t_ns, reading_z, sensor_z):
        """ΔH since the previous reading, desired minus previous actual offset; the first counts at once."""
        place = self.poses[-1][1][:2]
        fresh = None if reading_z is None else (t_ns, self.range_m[0], reading_z, *place)
        previous = self.reading
        if fresh and (previous is None or t_ns - previous[0] > self.params["loss_timeout_ns"]):
            previous = fresh
        if fresh:
            self.reading = fresh
            before = self.poses[-2][1] if len(self.poses) > 1 else place
            self.heading = (place[0] - before[0], place[1] - before[1])
        if previous is None:
            return 0.0, 0.0
        since_ns, distance, z, x, y = previous
        # the tool's own motion since is known, and no part of the surface's
        actual = distance + (sensor_z - z)
        error, since = self.params["offset_m"] - actual, (t_ns - since_ns) * 1e-9
        if not fresh:
            # no farther than the poses tell, and an interval
            stamp, tool = self.poses[-1]
            u, v = self.heading
            way = math.sqrt(u * u + v * v)
            along = ((tool[0] - x) * u + (tool[1] - y) * v) / way if way > 0.0 else 0.0
            most = along + self.speed * ((t_ns - stamp) * 1e-9) + self.params["interval_size_m"]
            if self.speed * since > most:
                return self.slope * most, error
        return self.slope * self.speed * since, error

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
