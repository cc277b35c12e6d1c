"""Jobs of following at every scale, from a torch over a weld seam to an AUV above the sea bed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.benchmark import families as f
from surffollow.benchmark.conditions import Conditions, PoseConfig, SensorConfig
from surffollow.benchmark.disturbances import DISTURBANCES
from surffollow.benchmark.family_profiles import scaled_profile
from surffollow.benchmark.scene import Scene, make_scene
from surffollow.sim.plant import PlantConfig


@dataclass(frozen=True)
class Case:
    """One job at one scale, SI units; `sizes` of the ground."""

    name: str
    ground: Callable[..., Any]
    sizes: dict[str, float]
    standoff_m: float
    window_m: tuple[float, float]
    speed_mps: float
    sensor_hz: float
    sigma_m: float
    latency_s: float
    tau_s: float
    v_max_mps: float
    a_max_mps2: float
    pose_hz: float
    spikes: float = 0.01
    lost: float = 0.0
    duration_s: float = 40.0
    disturbance: str = ""  # of `benchmark.disturbances`
    undeclared_s: float = 0.0  # latency that the follower's timestamps do not tell
    to_all: bool = False  # nor those that the baselines get

    @property
    def conditions(self) -> Conditions:
        near, far = self.window_m
        return Conditions(
            plant=PlantConfig(self.tau_s, self.v_max_mps, self.a_max_mps2, self.pose_hz),
            pose=PoseConfig(self.pose_hz, 0.01, 0.2 * self.sigma_m),
            sensor=SensorConfig(
                self.sensor_hz,
                self.latency_s,
                self.sigma_m,
                near,
                far,
                14,
                self.spikes,
                0.3 * self.standoff_m,
            ),
            nominal_tau_s=self.tau_s,
            standoff_m=self.standoff_m,
            unscored_m=0.08 * self.duration_s * self.speed_mps,
        )

    def scene(self, seed: int) -> Scene:
        length = self.duration_s * self.speed_mps
        spacing = min(self.speed_mps * 2e-3, length / 4000)
        profile = scaled_profile(self.ground, seed, length, spacing, **self.sizes)
        scene = make_scene(profile, self.speed_mps, seed, self.conditions)
        if self.lost > 0.0:
            lost = np.random.default_rng([seed, 71]).random(len(scene.world.readings)) < self.lost
            scene.world.readings["noise"][lost] = np.nan
        if self.disturbance:
            DISTURBANCES[self.disturbance](scene)
        return scene


def _torch(
    name: str, v: float, hz: float, sigma: float, tau: float, pose_hz: float, h: float, **sizes: float
) -> Case:
    return Case(
        name,
        f.weld,
        sizes,
        h,
        (0.12 * h, 3.0 * h),
        v,
        hz,
        sigma,
        0.005,
        tau,
        0.2,
        4.0,
        pose_hz,
        duration_s=20.0,
    )


def _drone(
    name: str, ground: Any, v: float, hz: float, sigma: float, tau: float, h: float, **sizes: float
) -> Case:
    return Case(
        name, ground, sizes, h, (0.2, 12.0), v, hz, sigma, 0.05, tau, 2.5, 5.0, 50.0, 0.02, duration_s=80.0
    )


def _auv(name: str, v: float, hz: float, tau: float, h: float, **sizes: float) -> Case:
    return Case(
        name,
        f.terrain,
        sizes,
        h,
        (0.5, 50.0),
        v,
        hz,
        0.1,
        0.05,
        tau,
        0.8,
        0.4,
        10.0,
        0.02,
        0.07,
        duration_s=400.0,
    )


def _cell(name: str, ground: Any, **changes: Any) -> Case:
    """The benchmark's robot cell with something changed."""
    usual: dict[str, Any] = {"sensor_hz": 250.0, "latency_s": 0.03, "tau_s": 0.04, "speed_mps": 0.1}
    fixed: dict[str, Any] = {"sigma_m": 0.25e-3, "v_max_mps": 0.2, "a_max_mps2": 2.0, "pose_hz": 100.0}
    return Case(name, ground, {}, 0.1016, (0.0508, 0.1524), **(fixed | usual | changes))


_GROUNDS = {"terrain": f.terrain, "hull": f.hull, "casting": f.casting}
_ROWS: dict[str, dict[str, Any]] = {
    **{f"{hz:g} Hz": {"sensor_hz": hz} for hz in (2.0, 5.0, 9.0, 20.0, 50.0, 1000.0, 2000.0)},
    **{name: {"disturbance": name} for name in DISTURBANCES},
    "30 ms undeclared": {"latency_s": 0.06, "undeclared_s": 0.03},
    "30 ms undeclared to all": {"latency_s": 0.06, "undeclared_s": 0.03, "to_all": True},
    "τ 200 ms": {"tau_s": 0.2},
}

_SMALL = {"bow_m": 0.8e-3, "bead_m": 0.6e-3, "width_m": 4e-3, "every_m": 0.05}
_BED = {"rms_m": 1.5, "longest_m": 120.0, "shortest_m": 4.0}

CASES: dict[str, list[Case]] = {
    # the robot cell with other sensors, noise and axes
    "rows": [
        _cell(f"{row}, {ground}", make, **changes)
        for row, changes in _ROWS.items()
        for ground, make in _GROUNDS.items()
    ],
    # constants were looked at on these …
    "tune": [
        _torch("torch 4 mm, 50 mm/s", 0.05, 500.0, 0.05e-3, 0.03, 200.0, 0.004, **_SMALL),
        _torch("weld 6 mm, 20 mm/s", 0.02, 250.0, 0.02e-3, 0.05, 100.0, 0.006, **_SMALL),
        Case(
            "cell 100 mm, 100 mm/s",
            f.casting,
            {},
            0.1,
            (0.05, 0.15),
            0.1,
            250.0,
            0.25e-3,
            0.03,
            0.04,
            0.2,
            2.0,
            100.0,
        ),
        Case(
            "cell 60 mm, 50 Hz", f.hull, {}, 0.06, (0.02, 0.2), 0.2, 50.0, 0.5e-3, 0.02, 0.1, 0.2, 1.0, 100.0
        ),
        Case(
            "hull 0.5 m, 20 Hz",
            f.hull,
            {"dish_m": 0.03, "frame_m": 1.5, "seam_m": 0.01},
            0.5,
            (0.1, 2.0),
            0.3,
            20.0,
            4e-3,
            0.05,
            0.2,
            0.3,
            0.6,
            50.0,
            duration_s=80.0,
        ),
        _drone("drone 1 m/s, 10 Hz", f.hedges, 1.0, 10.0, 0.02, 0.5, 3.0),
        _drone("drone 3 m/s, 10 Hz", f.hedges, 3.0, 10.0, 0.02, 0.5, 3.0),
        _auv("AUV 10 m, 5 Hz", 1.5, 5.0, 2.0, 10.0, **_BED),
    ],
    # … and figures are published on these
    "publish": [
        _torch("torch 3 mm, 100 mm/s", 0.1, 1000.0, 0.03e-3, 0.02, 250.0, 0.003, **_SMALL),
        _torch(
            "weld 5 mm, 60 mm/s",
            0.06,
            300.0,
            0.08e-3,
            0.04,
            125.0,
            0.005,
            bow_m=1e-3,
            bead_m=1e-3,
            width_m=5e-3,
            every_m=0.08,
        ),
        Case(
            "cell 40 mm, 50 mm/s",
            f.lap_joints,
            {},
            0.04,
            (0.02, 0.1),
            0.05,
            500.0,
            0.05e-3,
            0.004,
            0.03,
            0.2,
            3.0,
            100.0,
        ),
        Case(
            "cell 150 mm, 300 mm/s",
            f.terrain,
            {"rms_m": 0.01},
            0.15,
            (0.05, 0.4),
            0.3,
            100.0,
            1e-3,
            0.05,
            0.08,
            0.3,
            2.0,
            100.0,
        ),
        Case(
            "hull 0.3 m, 10 Hz",
            f.hull,
            {"dish_m": 0.02, "frame_m": 1.0, "seam_m": 5e-3},
            0.3,
            (0.1, 1.5),
            0.15,
            10.0,
            3e-3,
            0.05,
            0.3,
            0.3,
            0.5,
            20.0,
            duration_s=120.0,
        ),
        Case(
            "field robot 0.8 m, 50 Hz",
            f.terrain,
            {"rms_m": 0.1, "longest_m": 15.0, "shortest_m": 0.4},
            0.8,
            (0.2, 3.0),
            1.0,
            50.0,
            8e-3,
            0.03,
            0.15,
            0.5,
            2.0,
            50.0,
            duration_s=60.0,
        ),
        _drone("drone 2 m/s, sea, 20 Hz", f.sea, 2.0, 20.0, 0.03, 0.4, 2.0),
        _drone("drone 5 m/s, 50 Hz", f.hedges, 5.0, 50.0, 0.02, 0.6, 4.5, every_m=60.0),
        _auv("AUV 15 m, 2 Hz", 1.2, 2.0, 3.0, 15.0, **_BED),
        _auv("winch 8 m, 1 Hz", 1.0, 1.0, 1.5, 8.0, **_BED),
    ],
}
