"""A tilted tool over a plane."""

from __future__ import annotations

import math

import numpy as np

from surffollow import Follower

MS = 1_000_000


UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def turned(pitch_deg: float, roll_deg: float = 0.0) -> tuple[float, float, float, float]:
    """Unit quaternion: first rolled about x, then pitched about y."""
    p, r = math.radians(pitch_deg) / 2.0, math.radians(roll_deg) / 2.0
    cp, sp, cr, sr = math.cos(p), math.sin(p), math.cos(r), math.sin(r)
    return cp * sr, sp * cr, -sp * sr, cp * cr


def times(p, q) -> tuple[float, float, float, float]:
    """Product of two quaternions: first q's rotation, then p's."""
    u, v = np.array(p[:3]), np.array(q[:3])
    x, y, z = p[3] * v + q[3] * u + np.cross(u, v)
    return x, y, z, p[3] * q[3] - u @ v


def rotated(q, v) -> np.ndarray:
    u, v = np.array(q[:3]), np.array(v)
    return v + 2.0 * np.cross(u, np.cross(u, v) + q[3] * v)


def beam_of(q) -> np.ndarray:
    """Where a sensor of this orientation looks."""
    return rotated(q, [0.0, 0.0, -1.0])


class Tilted:
    """A robot of τ = 40 ms with a tilted tool over a plane, or over hills with flanks along x."""

    def __init__(
        self, q, slope: float = 0.0, hill_m: float = 0.0, mount=(0.0, 0.0, 0.0), turn=UPRIGHT, frame=UPRIGHT
    ) -> None:
        """`mount`, `turn`: the sensor's place beside the axis and rotation, at an untilted tool.

        `frame`: how the tool's axes are named; what it does is the same.
        """
        back = (*(-np.array(frame[:3])), frame[3])
        sensor = {"position_m": rotated(frame, mount).tolist(), "orientation": times(frame, turn)}
        self.f = Follower({"sensors": [sensor]}, offset_m=0.1)
        self.q, self.beam, self.slope, self.hill_m, self.offset_m = q, beam_of(q), slope, hill_m, 0.1
        self.sees_from, self.sees_along, self.pose_q = (
            rotated(q, mount),
            beam_of(times(q, turn)),
            times(q, back),
        )
        offset_m = self.offset_m
        self.rng, self.t_ms, self.v_mps = np.random.default_rng(7), 10_000, 0.0
        self.z_m = self.ground(self.beam[0] * offset_m) - self.beam[2] * offset_m

    def ground(self, x_m: float) -> float:
        return self.slope * x_m + self.hill_m * math.tanh(3.0 * math.sin(27.0 * x_m) + math.sin(11.0 * x_m))

    def range_at(self, x_m: float, origin, along) -> float:
        """How far the ground is from a point beside the tool."""
        r = self.offset_m
        for _ in range(30):
            gap = self.z_m + origin[2] + along[2] * r - self.ground(x_m + origin[0] + along[0] * r)
            r -= gap / (along[2] - self.slope * along[0])
            if abs(gap) < 1e-12:
                break
        return r

    def carry(self, speed_mps: float, way_m: float) -> np.ndarray:
        """Errors of the distance along the axis of every millisecond of a way from x = 0 [m]."""
        out = []
        for k in range(round(way_m / speed_mps * 1e3)):
            t_ns, x_m = (self.t_ms + k) * MS, speed_mps * k * 1e-3
            r = self.range_at(x_m, self.sees_from, self.sees_along)
            if k % 10 == 0:
                reported = self.z_m
                self.f.pose(t_ns, (x_m, 0.0, self.z_m, *self.pose_q))
            if k % 4 == 0:
                self.f.step(t_ns, [r + 1e-4 * self.rng.standard_normal()])
            if k % 10 == 0:
                goal = reported + float(self.f.step(t_ns, [math.nan])[2])
            wish = min(max((goal - self.z_m) / 0.04, -0.2), 0.2)
            self.v_mps += min(max(wish - self.v_mps, -2e-3), 2e-3)
            self.z_m += 1e-3 * self.v_mps
            out.append(self.range_at(x_m, (0.0, 0.0, 0.0), self.beam) - self.offset_m)
        self.t_ms += round(way_m / speed_mps * 1e3)
        return np.array(out)

    def go_back(self) -> None:
        """Lifted, carried back to x = 0 and put down where it started, without readings."""
        begin, end = self.ground(self.beam[0] * self.offset_m) - self.beam[2] * self.offset_m, self.z_m
        for k in range(320):
            f = min(k / 300.0, 1.0)
            z_m = end + f * (begin - end) + 0.05 * min(1.0, 10.0 * f, 10.0 * (1.0 - f))
            self.f.pose((self.t_ms + 10 * k) * MS, (0.6 * (1.0 - f), 0.0, z_m, *self.pose_q))
            self.f.step((self.t_ms + 10 * k) * MS, [math.nan])
        self.t_ms += 3200
        self.z_m, self.v_mps = begin, 0.0
