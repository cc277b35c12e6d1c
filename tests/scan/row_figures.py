"""Figures of the motion in a path file, row by row."""

from __future__ import annotations

import csv
import math
from dataclasses import fields

import numpy as np
from scipy.spatial.transform import Rotation

from surffollow.scan.timing import MotionLimits


def greatest(file):
    """Greatest figures of a path file's rows: velocities and angles of three rows at a time."""
    with open(file) as f:
        rows = list(csv.DictReader(line for line in f if not line.startswith("#")))
    t, *place = ([float(r[c]) for r in rows] for c in ("t_s", "x_m", "y_m", "z_m"))
    q = np.array([[float(r[c]) for c in ("qx", "qy", "qz", "qw")] for r in rows])
    turned = Rotation.from_quat(q)
    angles = (turned[:-1].inv() * turned[1:]).magnitude()
    made = dict.fromkeys((f.name for f in fields(MotionLimits)), 0.0)

    def most(name, value):
        made[name] = max(made[name], value)

    v = np.diff(place, axis=1) / np.diff(t)
    for k in range(len(rows) - 1):
        speed = math.hypot(v[0, k], v[1, k])
        most("speed_mps", speed)
        if not math.isnan(v[2, k]):
            most("vertical_mps", abs(v[2, k]))
        most("tilt_radps", float(angles[k]) / (t[k + 1] - t[k]))
        if k:
            dt = 0.5 * (t[k + 1] - t[k - 1])
            before = math.hypot(v[0, k - 1], v[1, k - 1])
            most("acceleration_mps2", abs(speed - before) / dt)
            turn = math.atan2(v[1, k], v[0, k]) - math.atan2(v[1, k - 1], v[0, k - 1])
            turn = abs(math.remainder(turn, 2 * math.pi))
            most("lateral_mps2", turn * 0.5 * (speed + before) / dt)
            if not math.isnan(v[2, k] - v[2, k - 1]):
                most("vertical_mps2", abs(v[2, k] - v[2, k - 1]) / dt)
    for k in (0, -1):  # from rest and to rest
        most("vertical_mps2", 2.0 * abs(v[2, k]) / (t[1] - t[0] if k == 0 else t[-1] - t[-2]))
    return made
