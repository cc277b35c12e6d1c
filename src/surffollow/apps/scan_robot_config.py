"""Settings of a simulated arm that executes scan paths, and which paths it takes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats
from surffollow.scan.path import OUT_OF_REACH, ScanPath
from surffollow.scan.shaping import Shaper
from surffollow.sim.flexible_tip import Compliance
from surffollow.sim.plant import PlantConfig

WAYS = ("feedforward", "map", "plan")
RETRACT_M = 0.1  # above the ground after a scan


@dataclass(frozen=True)
class ArmErrors:
    """Errors of the arm's model: the stiff real tip minus the commanded one.

    Attributes
    ----------
    sag_at_2m_m : sag at 2 m of reach that the model lacks, growing with the square of the reach [m]
    heading_rad : of the base
    base_m : place of the base (x, y, z) [m]
    """

    sag_at_2m_m: float = 0.005
    heading_rad: float = 0.003
    base_m: tuple[float, float, float] = (0.002, -0.002, 0.001)

    def offset_m(self, tip_m: Floats, base_m: Floats) -> Floats:
        """(n, 3) what is added to commanded tips (n, 3) [m]."""
        d = tip_m - base_m
        reach = np.hypot(d[:, 0], d[:, 1])
        made = np.empty_like(tip_m)
        made[:, 0] = self.base_m[0] - self.heading_rad * d[:, 1]
        made[:, 1] = self.base_m[1] + self.heading_rad * d[:, 0]
        made[:, 2] = self.base_m[2] - self.sag_at_2m_m * (reach / 2.0) ** 2
        return made


@dataclass(frozen=True)
class ScanRobotConfig:
    """A simulated arm and how it uses plan and follower.

    Attributes
    ----------
    way : str                     "feedforward": the plan's height plus a slow correction by the demand;
        "map": the follower's demand alone, over a map that was installed; "plan": no sensor at all
    rise_s, sink_s : float [s]    time constants of the correction away from the ground and toward it
    most_m : float [m]            largest correction of the plan; None: the path's gap, beyond which its map
        is of no use
    shaper : Shaper               input shaper of the height command, so that following does not excite the
        arm's vertical mode, which the sensor measures and the joints do not; None: not shaped
    errors : ArmErrors            None: the model is exact
    compliance : Compliance       None: a stiff arm
    report_latency_s, report_sigma_m : of pose reports [s], noise of x, y and z [m]
    retract_m : float [m]         after the scan and when it is aborted
    command_timeout_s : float     the drives stop when the controller says nothing for so long [s]
    seed : int                    of the noise
    """

    way: str = "feedforward"
    rise_s: float = 0.1
    sink_s: float = 0.4
    most_m: float | None = None
    shaper: Shaper | None = None
    errors: ArmErrors | None = field(default_factory=ArmErrors)
    compliance: Compliance | None = field(default_factory=Compliance)
    plant: PlantConfig = field(default_factory=lambda: PlantConfig(v_max_mps=0.5, a_max_mps2=4.0))
    report_latency_s: float = 0.010
    report_sigma_m: float = 0.05e-3
    retract_m: float = RETRACT_M
    command_timeout_s: float = 0.05
    seed: int = 1

    def __post_init__(self) -> None:
        if self.way not in WAYS:
            raise ScanInputError(f"way is '{self.way}'; expected one of {', '.join(WAYS)}")
        for name in ("rise_s", "sink_s", "most_m", "retract_m", "command_timeout_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ScanInputError(f"{name} is {value:g}; expected a finite number above 0")


def check_executable(path: ScanPath) -> None:
    """Refuse a path that cannot be run.

    Raises
    ------
    ScanInputError
        samples without height or beyond the arm's reach, times that do not grow, no gap among its facts
    """
    if len(path) < 2:
        raise ScanInputError(f"the path has {len(path)} samples; a run needs at least 2")
    gap = path.facts.get("gap_m")
    if not isinstance(gap, (int, float)) or not gap > 0.0:
        raise ScanInputError(f"the path's gap_m is {gap}; expected a length above 0: plan it again")
    bad = ~np.isfinite(path.position_m).all(axis=1) | ~np.isfinite(path.normal).all(axis=1)
    if bad.any():
        raise ScanInputError(
            f"{int(bad.sum())} of {len(path)} samples have no height (unknown ground); plan a smaller "
            "region, or fill holes of the map (scan plan --fill)"
        )
    far = path.has(OUT_OF_REACH)
    if far.any():
        raise ScanInputError(
            f"{int(far.sum())} of {len(path)} samples are out of the arm's reach; plan a smaller region"
        )
    steps = np.diff(path.t_s)
    if not np.isfinite(path.t_s).all() or not (steps >= 0.0).all() or path.t_s[-1] <= path.t_s[0]:
        raise ScanInputError("the path's times do not ascend; plan it again")
