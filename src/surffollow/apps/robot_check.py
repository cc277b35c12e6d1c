"""Watch a running service while its tool moves up and down, and evaluate poses against ranges; reads only."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from surffollow.apps.fit_robot import (
    Floats,
    count_legs,
    fit_gain,
    sensor_heights,
    span,
    white_noise_m,
)
from surffollow.apps.gain_verdict import Finding, length
from surffollow.apps.lag_search import LONGEST_S
from surffollow.apps.robot_verdict import (
    PRECISE,
    ChannelFacts,
    channel_finding,
    finding_dict,
    is_precise,
    motion_finding,
)
from surffollow.client.board import Board
from surffollow.client.cycle_log_reader import (
    FLAG_INVALID,
    FLAG_OUTSIDE,
    OUTSIDE_M,
    Conversion,
    CycleLogReader,
    PoseReport,
)
from surffollow.config.trusted_users import trusted_owners
from surffollow.errors import BlockError, NotRunningError
from surffollow.shm.layout_board import MainThreadState, Stats
from surffollow.shm.layout_follow import Params

PART = 0.1  # of the stand-off, least move
NOISES = 20.0  # least move, as a multiple of the reported heights' noise: it lowers the gain by 2 %
LEGS = 3  # up, down, up
MOST_LEGS = 12  # more do not help
LEAST_S = 4.0  # of a watch that ends by itself
SPACING_NS = 2_000_000  # between the samples that are kept of each kind
_COUNTERS = ("poses_refused", "conversions_refused", "ranges_refused")


class RobotCheck:
    """Collects pose reports and readings of a service, and evaluates them.

    Parameters
    ----------
    name : str   of the service

    Raises
    ------
    NotRunningError, NoPermissionError, LayoutMismatchError
        from opening the board; the service has ended
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._board = Board(name, owners=trusted_owners())
        if self._board.has_ended():
            raise NotRunningError(f"service {name!r} ended; start it again (surffollow start --name {name})")
        params = self._board.latch("params", Params).read()
        if params is None:
            raise BlockError(f"service {name!r} has published no parameters yet; try again")
        self._params = params
        self._log = CycleLogReader(self._board)
        self._counted = self._counters()
        self._began_ns = time.monotonic_ns()
        self._poses: list[PoseReport] = []
        self._readings: list[list[Conversion]] = [[] for _ in range(int(params["n_channels"]))]
        self.has_ended = False

    def _counters(self) -> dict[str, int]:
        stats = self._board.plain("stats", Stats)
        return {name: int(stats[name]) for name in _COUNTERS}

    @property
    def standoff_m(self) -> float:
        """Stand-off in force [m]."""
        return float(self._params["offset_m"])

    def seconds(self) -> float:
        """Time since the beginning [s]."""
        return 1e-9 * (time.monotonic_ns() - self._began_ns)

    def take(self) -> None:
        """Collect what came since the last call, thinned."""
        self.has_ended = self._board.has_ended()
        poses, conversions = self._log.take()
        for report in poses:
            # a clock that was set goes back: what came before is of no use
            if self._poses and report.t_ns <= self._poses[-1].t_ns:
                self._poses.clear()
            if not self._poses or report.t_ns - self._poses[-1].t_ns >= SPACING_NS:
                self._poses.append(report)
        for conversion in conversions:
            if conversion.channel < len(self._readings):
                kept = self._readings[conversion.channel]
                if not kept or conversion.t_ns - kept[-1].t_ns >= SPACING_NS:
                    kept.append(conversion)

    def _motion(self) -> tuple[Floats, Floats, float, int]:
        """Times [s], poses (n, 7), needed travel [m] and legs."""
        t_s = 1e-9 * np.array([p.t_ns - self._began_ns for p in self._poses], np.float64)
        poses = np.array([p.pose for p in self._poses], np.float64).reshape(-1, 7)
        needed_m = max(PART * self.standoff_m, NOISES * white_noise_m(t_s, poses[:, 2]))
        return t_s, poses, needed_m, count_legs(poses[:, 2], 0.5 * needed_m)

    def progress(self) -> str:
        """State of the watch, as a line."""
        _, poses, needed_m, legs = self._motion()
        if not len(poses):
            return f"{self.seconds():.0f} s: no pose report yet"
        counts = ", ".join(str(len(kept)) for kept in self._readings)
        return (
            f"{self.seconds():.0f} s: height moved {length(span(poses[:, 2]))} of {length(needed_m)} needed, "
            f"{legs} of {LEGS} moves up or down; readings {counts}"
        )

    def is_enough(self) -> bool:
        """Whether the tool moved enough for every channel."""
        t_s, poses, needed_m, legs = self._motion()
        if self.seconds() < LEAST_S or legs < LEGS or span(poses[:, 2]) < needed_m:
            return False
        # readings count up to LONGEST_S before the last report: the last move has to be among them
        if count_legs(poses[t_s < t_s[-1] - LONGEST_S, 2], 0.5 * needed_m) < LEGS:
            return False
        if legs >= MOST_LEGS:
            return True
        return all(
            c["gain_sigma"] is not None
            and is_precise(c["gain"], c["gain_sigma"], 0.5 * PRECISE)
            and c["verdict"] != "ambiguous"
            for c in self.report()["channels"]
        )

    def report(self) -> dict[str, Any]:
        """The result, ready for JSON but for NaN; `is_right` says whether all is."""
        t_s, poses, needed_m, legs = self._motion()
        lateral_m = {"x": span(poses[:, 0]), "y": span(poses[:, 1])}
        travel_m = span(poses[:, 2])
        found = motion_finding(travel_m, needed_m, lateral_m, len(poses))
        channels = (
            [self._channel(c, t_s, poses, needed_m) for c in range(len(self._readings))] if len(poses) else []
        )
        if found and found.kind == "not enough motion" and any(c["verdict"] == "unit" for c in channels):
            found = None  # the channel says more
        verdicts = [found.kind] if found else []
        verdicts += [c["verdict"] for c in channels if c["verdict"] != "OK"]
        refused = {n: v - self._counted[n] for n, v in self._counters().items()}
        state = self._board.latch("ticker", MainThreadState).read() or {}
        return {
            "name": self.name,
            "is_right": not verdicts,
            "verdict": verdicts[0] if verdicts else "OK",
            "seconds": self.seconds(),
            "reports": len(poses),
            "motion": {
                "height_m": travel_m,
                "needed_m": needed_m,
                "x_m": lateral_m["x"],
                "y_m": lateral_m["y"],
                "moves": legs,
                **finding_dict(found or Finding("OK", "the tool moved up and down over one spot")),
            },
            "channels": channels,
            **refused,
            "lost": self._log.lost,
            "has_ended": self.has_ended,
            "note": str(state.get("text", "")),
        }

    def _channel(self, channel: int, t_s: Floats, poses: Floats, needed_m: float) -> dict[str, Any]:
        p, kept = self._params, self._readings[channel]
        words = np.array(kept, np.int64).reshape(-1, 4)
        is_outside = words[:, 3] & FLAG_OUTSIDE != 0
        is_distance = (words[:, 3] & FLAG_INVALID == 0) | is_outside
        counts = words[:, 1].astype(np.float64)
        range_m = np.where(
            is_outside, OUTSIDE_M * counts, p["zero_m"][channel] + p["scale_m"][channel] * counts
        )
        in_window = (range_m > p["range_min_m"]) & (range_m < p["range_max_m"]) & ~is_outside
        known_m = range_m[is_distance]
        reading_t_s = 1e-9 * (words[is_distance, 0] - self._began_ns)
        mount = np.array(p["tool_from_sensor"][7 * channel : 7 * channel + 7])
        height_m, beam_z = sensor_heights(poses, mount)
        fit = fit_gain(t_s, height_m, beam_z, reading_t_s, known_m)
        latency_s = 1e-9 * p["sensor_latency_ns"]
        facts = ChannelFacts(
            readings=len(words),
            invalid=int(np.sum(~is_distance)),
            outside=int(np.sum(is_distance & ~in_window)),
            range_min_m=p["range_min_m"],
            range_max_m=p["range_max_m"],
            middle_m=float(np.median(known_m)) if len(known_m) else float("nan"),
            beam_z=float(np.median(beam_z)),
            travel_m=span(height_m),
            needed_m=needed_m,
            latency_s=latency_s,
            tau_s=p["plant_tau_s"],
        )
        fitted = {}
        if fit is not None and np.isfinite(fit.gain_sigma):  # a gain without motion means nothing
            fitted = {f: getattr(fit, f) for f in fit.__struct_fields__}
        return {
            "channel": channel,
            "gain": fitted.get("gain"),
            "gain_sigma": fitted.get("gain_sigma"),
            "lag_s": fitted.get("lag_s"),
            "lag_sigma_s": fitted.get("lag_sigma_s"),
            "latency_s": latency_s,
            "noise_m": fitted.get("noise_m"),
            "range_m": facts.middle_m,
            "range_span_m": fitted.get("range_span_m"),
            "readings": facts.readings,
            "invalid": facts.invalid,
            "outside": facts.outside,
            **finding_dict(channel_finding(fit, facts)),
        }

    def close(self) -> None:
        """Unmap the board."""
        self._board.close()
