"""The follower in process: the service's kernels without daemon, shared memory or clock.

    f = surffollow.Follower({"mode": "adaptive"}, offset_m=0.1)
    f.pose(t_ns, (x, y, z, qx, qy, qz, qw))      # whenever a pose report arrives
    demand = f.step(t_ns, [range_m])             # six numbers to add to the newest pose reported

Times are int64 ns of one clock, which may begin at 0. A reading's timestamp may lie before the last step's.
In the adaptive mode timestamps that jump away from those of poses and other steps are corrected
(`reading_stamps`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import check_param, names_given
from surffollow.config.window_fit import FITTED, check_fit
from surffollow.errors import PoseError, UsageError
from surffollow.follower.given_values import write_pose, write_ranges
from surffollow.follower.kernel_time import PoseIntervals, kernel_time
from surffollow.follower.range_forecast import RangeForecast, forecast_range, observe_range
from surffollow.follower.reading_stamps import Timestamps
from surffollow.follower.setup import Config, read_setup
from surffollow.follower.standing_clock import StandingClock
from surffollow.follower.state_report import state_report
from surffollow.forecast.pose import report_pose
from surffollow.forecast.step import follow_step, sf_reset
from surffollow.forecast.terrain.terrain_memory import new_memory, read_preview, store_footprint
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import (
    CHANNELS,
    CLOCK_SET,
    MODE_ADAPTIVE,
    REFUSED,
    FollowState,
    Inputs,
    Output,
    Params,
)
from surffollow.units import real_number


class Follower:
    """Follow a surface: poses and readings in, demands out, nothing else.

    Parameters
    ----------
    config : dict, path of a TOML file, or None
        parameters by name (`surffollow.config.params`), SI numbers or text with units; `mode` is
        "adaptive" (default) or "paper". `sensors`: list of tables with `position_m` (3), `orientation`
        (unit quaternion, 4), `near_m`, `far_m` (one window for all); `plant`: table with `tau_s`,
        `v_max_mps`, `a_max_mps2`.
        `memory` = false: do not use ground seen on earlier passes. `sensor_readings` (default 1 here): so
        many ranges of a channel are averaged into a reading
    offset_m : float, optional
        desired stand-off along the beam of channel 0 [m]; default that of the configuration

    Raises
    ------
    ConfigError
        unknown key, wrong unit, value out of bounds or given in two ways, a stand-off that cannot be kept

    Examples
    --------
    >>> import surffollow
    >>> follower = surffollow.Follower({"mode": "paper"}, offset_m=0.1)
    >>> for k in range(200):
    ...     t_ns = k * 4_000_000
    ...     _ = follower.pose(t_ns, (0.0002 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
    ...     demand = follower.step(t_ns, [0.09])
    >>> round(float(demand[2]), 3), follower.state()["offset_m"]
    (0.01, 0.1)
    """

    def __init__(self, config: Config = None, offset_m: float | None = None) -> None:
        self._params, self._state = zeros(Params), zeros(FollowState)
        self._inputs, self._output = zeros(Inputs), zeros(Output)
        self._scratch, self._pose = np.zeros(7), np.zeros(7)
        self._forecast = zeros(RangeForecast)
        self._bind_views()
        self._latest_ns = self._stepped_ns = 0
        setup = read_setup(config, offset_m)
        for name, number in setup.values.items():
            self._params[name] = number
        self._params["n_channels"] = len(setup.mounts)
        mounts = self._params["tool_from_sensor"][0].reshape(CHANNELS, 7)
        mounts[:, 6] = 1.0
        mounts[: len(setup.mounts)] = setup.mounts
        adaptive = self._params["mode"][0] == MODE_ADAPTIVE
        self._checks_stamps = bool(adaptive)
        self._memory = new_memory() if setup.use_memory and adaptive else None
        sf_reset(self._params, self._state, float(self._params["offset_m"][0]))
        self._stamps, self._pose_intervals = Timestamps(), PoseIntervals()
        self._standing = StandingClock()
        self._n_channels = len(setup.mounts)
        self._scale_times()

    def _bind_views(self) -> None:
        """Views of fields that every step reads or writes."""
        self._t_ns, self._given_t_ns = self._inputs["t_ns"], self._inputs["given_t_ns"]
        self._n_ranges, self._given_m = self._inputs["n_ranges"], self._inputs["given_m"][0]
        self._demand, self._scaled = self._output["demand"][0], self._state["scaled"][0]
        self._pose_timeout_ns = self._params["pose_timeout_ns"]

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Bind the views anew: those of a copy or a pickle are arrays of their own."""
        self.__dict__.update(attributes)
        self._bind_views()

    def __copy__(self) -> Follower:
        """Copy deeply: two followers with records in common would both step them."""
        return copy.deepcopy(self)

    def _scale_times(self) -> None:
        """Times of the caller's clock that follow from the reference time."""
        self._stamps.time.set_scale(float(self._scaled["time"]))
        self._jump_ns = self._stamps.time.jump_ns

    def set_params(self, **values: object) -> None:
        """Change parameters from the next step on.

        Parameters
        ----------
        values : any
            parameters by name, with or without the ending of the name; SI numbers or text with units

        Raises
        ------
        ConfigError
            unknown name, wrong unit, value out of bounds or at odds with another; then nothing is changed
        """
        self._change({full: check_param(name, values[name]) for full, name in names_given(values).items()})

    def _change(self, values: dict[str, float]) -> None:
        """Put checked values in force, or raise ConfigError when they do not fit the others."""
        check_fit({name: float(self._params[name][0]) for name in FITTED} | values)
        for name, number in values.items():
            self._params[name] = number

    def reset(self, offset_m: float | None = None, *, keep_memory: bool = False) -> None:
        """Restart the forecast, with a new desired stand-off [m] if given; poses stay (paper: SFReset).

        Ground remembered from earlier passes is forgotten too. With `keep_memory` it stays, as the
        service's map does in a SFReset: for another stand-off over a part that was not moved.

        Parameters
        ----------
        offset_m : float, optional
            desired stand-off [m]; None: as before
        keep_memory : bool
            keep the ground remembered from earlier passes

        Raises
        ------
        ConfigError
            the stand-off is out of bounds, or cannot be kept in the sensor's window
        """
        if offset_m is not None:
            self._change({"offset_m": check_param("offset_m", offset_m)})
        self._stamps.reset()
        before = float(self._scaled["length"]), float(self._scaled["time"])
        sf_reset(self._params, self._state, float(self._params["offset_m"][0]))
        self._scale_times()
        # cells of other reference scales are of no use
        scales = float(self._scaled["length"]), float(self._scaled["time"])
        if self._memory is not None and (not keep_memory or scales != before):
            self._memory[:] = np.zeros((), self._memory.dtype)

    def pose(self, t_ns: int, pose: Sequence[float] | NDArray[Any]) -> bool:
        """Take a pose report.

        Parameters
        ----------
        t_ns : int
            when the pose was true, a whole number of ns; reports may arrive late
        pose : 7 numbers
            measured, not commanded (docs/explanation/frames.md#measured-not-commanded): x y z [m],
            qx qy qz qw (unit), world from tool; z of the world is up, a beam leaves along -z of its sensor

        Returns
        -------
        bool
            False: refused, because a pose at least as new was there already

        Raises
        ------
        PoseError
            not seven finite numbers, a quaternion whose norm is off by more than 1e-3, a time that is no
            whole number or more than an hour before 0, or 100 poses in succession less than 1 µs apart: then
            the times are in another unit. Or 100 poses in succession that changed while their time did not:
            then the clock stands still or is too coarse
        """
        write_pose(self._pose, pose)
        t = kernel_time(t_ns, PoseError)
        self._standing.check_pose(t, self._pose)
        answer = int(report_pose(self._state, self._stepped_ns, t, self._pose))
        if answer == CLOCK_SET:
            self._latest_ns = t
            self._stamps.note_clock_set(t)
        if answer != REFUSED:
            self._pose_intervals.check(t)
            self._stamps.note_pose(t)
        return answer != REFUSED

    def step(self, t_ns: int, ranges_m: Sequence[float | None] | NDArray[Any]) -> NDArray[np.float64]:
        """Step once, with readings or without.

        Parameters
        ----------
        t_ns : int
            when the ranges were read, a whole number of ns; without any, now
        ranges_m : one per sensor
            distances per channel [m]; NaN or None: no reading in this step; a number outside
            the window: the sensor lost the surface. [NaN] alone: no reading of any sensor

        Returns
        -------
        (6,) float64
            demand x y z [m], rx ry rz [rad], to be added to the newest pose reported

        Raises
        ------
        UsageError
            not a number for each sensor, a time that is no whole number or more than an hour before 0, or 100
            steps in succession whose readings changed while neither their time nor that of the poses did

        Notes
        -----
        The sequence of stages: docs/explanation/following.md.
        """
        n = write_ranges(self._given_m, ranges_m, self._n_channels)
        t = kernel_time(t_ns)
        given_m = self._given_m[:n].tolist()
        self._standing.check_step(t, given_m)
        self._stepped_ns = t
        if self._checks_stamps:
            t = self._checked_stamp(t, given_m)
        self._n_ranges[0] = n
        self._t_ns[0] = self._given_t_ns[0] = t
        self._latest_ns = max(t, self._latest_ns if self._latest_ns - t <= self._jump_ns else t)
        if self._latest_ns - t > self._pose_timeout_ns[0]:
            self._t_ns[0] = self._latest_ns  # an old reading is no reason to take the poses for future ones
        if self._memory is not None:
            read_preview(self._memory, self._params, self._state, self._inputs)
        follow_step(self._params, self._state, self._inputs, self._output, self._scratch)
        observe_range(self._params, self._state, self._forecast)
        if self._memory is not None:
            store_footprint(self._memory, self._state, self._output)
        demand: NDArray[np.float64] = self._demand.copy()
        return demand

    def _checked_stamp(self, t_ns: int, given_m: list[float]) -> int:
        """The step's time; readings whose timestamp must be wrong are dropped."""
        first = next((c for c, r in enumerate(given_m) if r == r), None)
        self._stamps.time.timeout_ns = float(self._pose_timeout_ns[0])
        t, dropped = self._stamps.check(t_ns, first)
        if dropped:
            self._given_m[: len(given_m)] = math.nan
        else:
            self._stepped_ns = t
        return t

    def forecast_range_m(self, horizon_s: float) -> float:
        """The range that channel 0 will read `horizon_s` [s] after its last valid reading; NaN before one.

        Parameters
        ----------
        horizon_s : float
            time after the last valid reading [s]

        Returns
        -------
        float
            range [m], NaN before the first valid reading

        Raises
        ------
        UsageError
            the time is no finite number

        Notes
        -----
        It is made for horizons of several sample intervals and at least 3 τ of the axis (0.12 s by default);
        below, and where the range swings within 75 τ (3 s), the newest range of a quick sensor with little
        noise is often the better forecast.
        """
        horizon = real_number(horizon_s, "horizon_s")
        if not math.isfinite(horizon):
            raise UsageError(f"horizon_s is {horizon:g} s; it must be finite")
        return float(forecast_range(self._params, self._state, self._forecast, horizon))

    def surface(self) -> tuple[float, float]:
        """Estimate of the surface alone, for a loop over many rows: `state` makes all its values anew.

        Returns
        -------
        (float, float)
            `height_m` [m] and `slope` of `state`
        """
        return float(self._output["height_m"][0]), float(self._output["slope"][0])

    def state(self) -> dict[str, Any]:
        """Estimates, health and adapted parameters as plain Python values.

        Returns
        -------
        dict
            in every mode: `status` (names of bits), `mode`, `offset_m`, `poses_refused`, `t_ns`, `pose_t_ns`,
            `cycle`, `height_m`, `slope`, `speed_mps`, `delta_h_m`, `error_m`, `demand` (6), `range_m` (per
            channel). In mode "adaptive" also `health`, `reason`, `faults`, `sigma_m`, `noise_m`,
            `roughness_m`, `late_s`, `latency_s`, `tau_s`, `permitted_variance_m`, `interval_size_m`,
            `range_size`, `beams`, `preview_share`, `weights`, and `normal` (3) once several
            sensors have read

        Notes
        -----
        `weights` are the probabilities of all models in the blend; their sum is 1
        (`forecast.estimation.model_bank`).
        """
        return state_report(self._params[0], self._state[0], self._output[0], self._stamps)
