"""Accuracy of the surface normal that a follower with several sensors finds over a static tilted plane."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.followers import follower_config
from surffollow.benchmark.loop import MS_NS
from surffollow.benchmark.scene import START_NS

RADIUS_M = 0.04
TILT = (0.06, -0.04)  # slopes of the plane along x and y
# of the way from the stand-off to the nearer end of the window, for the readings of the circle
WAY_SHARE = 0.5
SETTLE_MS, SCORED_MS = 1000, 2000


def radius_m(conditions: Conditions) -> float:
    """Radius of the sensors' circle [m]: 40 mm, less where the plane would leave a narrow window."""
    sensor, standoff_m = conditions.sensor, conditions.standoff_m
    way_m = min(standoff_m - sensor.near_m, sensor.far_m - standoff_m)
    return min(RADIUS_M, WAY_SHARE * way_m / math.hypot(*TILT))


def mounts(count: int, radius_m: float = RADIUS_M) -> NDArray[np.float64]:
    """(count, 2) positions of the sensors on their circle [m]."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.asarray(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def bound_rad(count: int, sigma_m: float, radius_m: float = RADIUS_M) -> float:
    """Cramér-Rao bound of the normal's angle (RMS) from one reading of each sensor [rad]."""
    design = np.column_stack([np.ones(count), mounts(count, radius_m)])
    covariance = sigma_m**2 * np.linalg.inv(design.T @ design)
    a, b = TILT
    # slopes to the angle on the unit sphere, along and across the steepest line
    steep = 1.0 + a * a + b * b
    along = np.array([a, b]) / math.hypot(a, b)
    across = np.array([-along[1], along[0]])
    c = covariance[1:, 1:]
    return math.sqrt(float(along @ c @ along) / steep**2 + float(across @ c @ across) / steep)


def plane_trial(method: str, count: int, seed: int, conditions: Conditions) -> dict[str, float]:
    """Hold a follower with `count` sensors still over a tilted plane.

    Only `surffollow.Follower` can be asked (sensor mounts are its configuration); a follower that gives no
    normal scores infinity.

    Parameters
    ----------
    method : str  name of the follower
    count : int   sensors
    seed : int
    conditions : Conditions

    Returns
    -------
    dict
        `angle_rad`: RMS angle between its normal and the plane's [rad]; `ratio`: over the bound
    """
    config, standoff_m = follower_config(conditions), conditions.standoff_m
    places = mounts(count, radius_m(conditions))
    config["sensors"] = [{**config["sensors"][0], "position_m": [float(x), float(y), 0.0]} for x, y in places]
    bound = bound_rad(count, conditions.sensor.sigma_m, radius_m(conditions))
    if method.partition("=")[0] != "ours":
        return {"angle_rad": math.inf, "ratio": math.inf}
    follower = importlib.import_module("surffollow").Follower(config=config, offset_m=standoff_m)
    rng = np.random.default_rng([seed, 71])
    normal = np.array([-TILT[0], -TILT[1], 1.0]) / math.sqrt(1.0 + TILT[0] ** 2 + TILT[1] ** 2)
    ranges = standoff_m - places @ np.array(TILT)
    pose = np.array([0.0, 0.0, standoff_m, 0.0, 0.0, 0.0, 1.0])
    squares: list[float] = []
    for ms in range(SETTLE_MS + SCORED_MS):
        if ms % 10 == 0:
            follower.pose(START_NS + ms * MS_NS, pose)
        if ms % 4 == 0:
            noise = conditions.sensor.sigma_m * rng.standard_normal(count)
            demand = follower.step(START_NS + ms * MS_NS, ranges + noise)
            if ms >= SETTLE_MS:
                found = estimated_normal(follower, demand)
                squares.append(
                    math.atan2(float(np.linalg.norm(np.cross(found, normal))), float(found @ normal)) ** 2
                )
    angle = math.sqrt(float(np.mean(squares)))
    return {"angle_rad": angle, "ratio": angle / bound}


def estimated_normal(follower: Any, demand: Any) -> NDArray[np.float64]:
    """Normal in a follower's state, else the tool axis turned by the demanded rotation vector."""
    reported = follower.state().get("normal")
    if reported is not None:
        return np.asarray(reported / np.linalg.norm(reported), np.float64)
    turn = np.asarray(demand[3:6], np.float64)
    angle = float(np.linalg.norm(turn))
    z = np.array([0.0, 0.0, 1.0])
    if angle == 0.0:
        return z
    k = turn / angle
    return np.asarray(
        z * math.cos(angle) + np.cross(k, z) * math.sin(angle) + k * k[2] * (1.0 - math.cos(angle))
    )
