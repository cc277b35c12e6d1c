"""Findings about a robot's poses and ranges, from the fits of a move up and down, with a remedy each."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from surffollow.apps.fit_robot import GainFit
from surffollow.apps.gain_verdict import FRAMES, NO_RESPONSE, SURE, Finding, classify_gain, length
from surffollow.apps.lag_search import SIGMAS

PRECISE = 0.02  # greatest standard error of a gain that is evaluated, as a part of it or of 1
EXPLAINED = 0.9  # of the ranges, where the heights hardly move
LATERAL = 0.25  # of the travel: motion sideways that is tolerated
LEAST_BEAM = 0.25  # cosine of the beam's tilt; nearer to level small errors of it are large ones of the gain
LAG_SHARE = 0.5  # of the axis' time constant: heights that are commanded lead by a whole one
MOST_OUTSIDE = 0.5  # of the readings, outside of the sensor's window


class ChannelFacts(msgspec.Struct, frozen=True):
    """Numbers of a channel beside its fit.

    Attributes
    ----------
    readings, invalid, outside : conversions in all, without a distance, and outside of the sensor's window
    range_min_m, range_max_m : that window [m]
    middle_m : median of the distances [m]; NaN: none
    beam_z : z component of the beam in the world, median; −1 straight down
    travel_m, needed_m : span of the sensor's height, and the one that is needed [m]
    latency_s, tau_s : configured latency of the sensor and time constant of the axis [s]
    """

    readings: int
    invalid: int
    outside: int
    range_min_m: float
    range_max_m: float
    middle_m: float
    beam_z: float
    travel_m: float
    needed_m: float
    latency_s: float
    tau_s: float


def motion_finding(
    travel_m: float, needed_m: float, lateral_m: dict[str, float], reports: int
) -> Finding | None:
    """A finding about the reported motion itself; None: it suits the check.

    Parameters
    ----------
    travel_m, needed_m : float    span of the tool's height, and the one that is needed [m]
    lateral_m : dict              span along x and along y [m]
    reports : int                 pose reports
    """
    if not reports:
        return Finding(
            "no poses",
            "no pose was accepted",
            "report poses while the check runs (client.ee_pos), with CLOCK_MONOTONIC timestamps in ns",
        )
    axis = max(lateral_m, key=lambda name: lateral_m[name])
    if travel_m < needed_m:
        if lateral_m[axis] >= needed_m and lateral_m[axis] > 2.0 * travel_m:
            return Finding(
                "lateral",
                f"the reported pose moved {length(lateral_m[axis])} along {axis}, and {length(travel_m)} in "
                "height",
                "move the tool up and down; if it did, the axes of the reports are in a wrong order",
            )
        return Finding(
            "not enough motion",
            f"the reported height moved by {length(travel_m)}, needed are {length(needed_m)}",
            "move the tool up and down farther while the check runs; if it moved, the reports do not follow "
            "the robot, or their unit is wrong",
        )
    if lateral_m[axis] > LATERAL * travel_m:
        return Finding(
            "lateral",
            f"the tool moved {length(lateral_m[axis])} sideways (along {axis}) while its height moved "
            f"{length(travel_m)}, allowed are {length(LATERAL * travel_m)}",
            "repeat the check over one spot; if the tool stayed over it, the attitude or the axes of the "
            "reports are wrong",
        )
    return None


def _readings_finding(facts: ChannelFacts) -> Finding | None:
    if facts.readings == 0:
        return Finding(
            "no readings", "the sensor gave no reading", "see surffollow status for the driver's note"
        )
    if facts.invalid == facts.readings:
        return Finding(
            "no readings",
            f"all {facts.readings} readings are flagged as no measurement",
            "bring the tool into the sensor's window; see surffollow status for the driver's note",
        )
    if facts.beam_z > -LEAST_BEAM:
        tilt = math.degrees(math.acos(max(-1.0, min(1.0, -facts.beam_z))))
        return Finding(
            "beam",
            f"the beam does not point downward: {tilt:.0f} deg from down by pose and mount",
            f"a beam leaves along -z of its sensor, z of the world and of the tool points up: see {FRAMES}",
        )
    return None


def is_precise(gain: float, gain_sigma: float, part: float = PRECISE) -> bool:
    """Whether the standard error of a gain is at most a part of it, or of 1."""
    return gain_sigma <= part * max(1.0, abs(gain))


def channel_finding(fit: GainFit | None, facts: ChannelFacts) -> Finding:
    """The verdict of a channel; its kind is "OK" where all is right."""
    found = _readings_finding(facts)
    if found and found.kind == "no readings":
        return found
    if fit is None:
        return Finding(
            "not enough motion", "too few readings lie within the pose reports", "watch for longer"
        )
    is_small = facts.travel_m < facts.needed_m
    is_clear = fit.explained > EXPLAINED and abs(fit.gain) > SURE * fit.gain_sigma
    if is_small and not (is_clear and fit.range_span_m >= facts.needed_m):
        return found or Finding("not enough motion", "the height moved too little to find a gain", "")
    # a sign that is sure is reported, however uncertain the gain
    is_reversed = fit.gain < -max(SURE * fit.gain_sigma, 0.5) and not fit.is_ambiguous
    if not is_precise(fit.gain, fit.gain_sigma) and not is_reversed:
        return Finding(
            "not enough motion",
            f"the gain is uncertain, {fit.gain:.3g} ± {fit.gain_sigma:.2g}: ranges scatter by "
            f"{length(fit.noise_m)} about the fit",
            "move farther, more often, and over level ground",
        )
    if fit.is_ambiguous and abs(fit.gain) >= NO_RESPONSE:
        return Finding(
            "ambiguous",
            "the move repeats itself: right and reversed ranges fit alike",
            "move more slowly, up and down in 2 s or more, with rests",
        )
    wrong = classify_gain(fit, facts.range_min_m < facts.middle_m < facts.range_max_m)
    if found:
        sign = (
            "range grows with the reported height" if fit.gain > 0.0 else "range shrinks as the height grows"
        )
        return Finding(found.kind, f"{found.text}; the {sign}", found.remedy)
    return wrong or _window_finding(facts) or _lag_finding(fit, facts) or _fine(fit)


def _window_finding(facts: ChannelFacts) -> Finding | None:
    if facts.outside <= MOST_OUTSIDE * (facts.readings - facts.invalid):
        return None
    return Finding(
        "window",
        f"{facts.outside} of {facts.readings} readings, such as {length(facts.middle_m)}, are outside of the "
        f"sensor's window of {length(facts.range_min_m)} to {length(facts.range_max_m)}",
        "hold the tool within the window, or correct range_min_m and range_max_m of [driver]",
    )


def _lag_finding(fit: GainFit, facts: ChannelFacts) -> Finding | None:
    if fit.lag_s is None or fit.lag_sigma_s is None:
        return None
    excess_s = fit.lag_s - facts.latency_s
    if abs(excess_s) <= LAG_SHARE * facts.tau_s + SIGMAS * fit.lag_sigma_s:
        return None
    who = (
        (
            "older",
            "ranges are late, poses are commanded instead of measured, or their timestamps are too old",
        )
        if excess_s > 0.0
        else ("newer", "poses have timestamps that are too new, such as those of their arrival")
    )
    return Finding(
        "lag",
        f"the ranges are {1e3 * abs(excess_s):.0f} ms {who[0]} than the poses and the configured latency of "
        f"{1e3 * facts.latency_s:.3g} ms say: {who[1]}",
        "report measured poses, and give both the time of the measurement, CLOCK_MONOTONIC in ns; a latency "
        "that remains is latency_s of [driver], see surffollow calibrate latency",
    )


def _fine(fit: GainFit) -> Finding:
    if fit.lag_s is None:
        return Finding("OK", "range follows height; the move does not determine the lag")
    return Finding("OK", "range follows height")


def finding_dict(found: Finding) -> dict[str, Any]:
    """A finding for JSON."""
    return {"verdict": found.kind, "text": found.text, "remedy": found.remedy}
