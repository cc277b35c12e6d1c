"""Findings about a gain, the change of ranges per height: reversed, another unit, a tilt, no response."""

from __future__ import annotations

import math

import msgspec

from surffollow.apps.fit_robot import GainFit
from surffollow.apps.lag_search import SIGMAS

TOLERANCE = 0.05  # of a gain: the cosine of 18 degrees
NO_RESPONSE = 0.05  # least gain that is more than a leak of the move into the ranges
SURE = 8.0  # standard errors that a gain near 0 must have, to be one of another unit
FRAMES = "docs/explanation/frames.md"
# [m]
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "ft": 0.3048, "um": 1e-6}


class Finding(msgspec.Struct, frozen=True):
    """A verdict: its kind for programs, a text and a remedy for people."""

    kind: str
    text: str
    remedy: str = ""


def length(value_m: float) -> str:
    """A length with a unit that suits it."""
    if abs(value_m) >= 9.995:
        return f"{value_m:.4g} m"
    return f"{1e3 * value_m:.3g} mm" if abs(value_m) < 0.9995 else f"{value_m:.3g} m"


def units_of(gain: float, sigma: float) -> tuple[str, str] | None:
    """Units of ranges and heights, each taken for metres, that give a gain; None: none does.

    Pairs with one wrong unit come before those with two. 1 is no unit's gain.
    """
    pairs = [(r, h) for r in UNITS for h in UNITS if r != h]
    fits = [
        (r != "m" and h != "m", abs(math.log(abs(gain) * UNITS[r] / UNITS[h])), (r, h))
        for r, h in pairs
        if abs(abs(gain) * UNITS[r] / UNITS[h] - 1.0) <= TOLERANCE + SIGMAS * sigma / abs(gain)
    ]
    return min(fits)[2] if fits else None


def _unit_finding(gain: float, units: tuple[str, str], is_in_window: bool) -> Finding:
    # the distances themselves say which of the two is less likely to be wrong
    twice = {False: "ranges", True: "heights"}[is_in_window]
    where = "within" if is_in_window else "outside of"
    is_odd = "m" in units and units[is_in_window] == "m"
    other = (
        f", or the {twice} are converted from {units[not is_in_window]} twice: the distances are {where} the "
        "sensor's window"
    )
    wrong = [f"{n} in {u}" for n, u in zip(("ranges", "heights"), units, strict=True) if u != "m"]
    turned = ", and the sign is reversed: z of the world points down" if gain < 0.0 else ""
    return Finding(
        "unit",
        f"ranges change {abs(gain):.4g} times as much as heights: the {' and the '.join(wrong)} "
        f"seem to be given as metres{other if is_odd else ''}{turned}",
        "convert to metres in the program that reports them or in [driver]"
        + (f", and see 'A world with z down' in {FRAMES}" if turned else ""),
    )


_REVERSED = Finding(
    "reversed",
    "ranges shrink where the reported height grows: z of the world points down in the reports",
    f"apply no demand; convert the poses and the demands, see 'A world with z down' in {FRAMES}",
)


def _scaled(gain: float) -> Finding:
    part = min(abs(gain), 1.0 / abs(gain))
    tilt = math.degrees(math.acos(part))
    beam = (
        f"the beam is tilted by about {tilt:.0f} deg more than mount and pose say"
        if abs(gain) > 1.0
        else f"mount or pose say a tilt of about {tilt:.0f} deg that the beam does not have"
    )
    likely = f"; perhaps {beam}" if part > 0.5 else ""
    return Finding(
        "scaled",
        f"ranges change {gain:.4g} times as much as heights along the beam, expected 1{likely}",
        "check the attitudes of mount and tool, then the sensor's scale: surffollow calibrate mount, "
        "calibrate range",
    )


def classify_gain(fit: GainFit, is_in_window: bool = True) -> Finding | None:
    """The finding about a gain that is known well enough; None: it is 1.

    `is_in_window` says whether the distances lie in the sensor's window.
    """
    gain, sigma = fit.gain, fit.gain_sigma
    allowed = TOLERANCE + SIGMAS * sigma
    if abs(gain - 1.0) <= allowed:
        return None
    if abs(gain) < NO_RESPONSE:
        units = units_of(gain, 0.0) if abs(gain) > SURE * sigma and gain != 0.0 else None
        return _unit_finding(gain, units, is_in_window) if units else _no_response(fit)
    if abs(gain + 1.0) <= allowed:
        return _REVERSED
    units = units_of(gain, sigma)
    if units:
        return _unit_finding(gain, units, is_in_window)
    if gain < 0.0:
        scale = _scaled(gain)
        return Finding("reversed", f"{_REVERSED.text}; {scale.text}", f"{_REVERSED.remedy}; {scale.remedy}")
    return _scaled(gain)


def _no_response(fit: GainFit) -> Finding:
    how = (
        "show one value"
        if fit.range_span_m == 0.0
        else f"change by {length(fit.range_span_m)}, but not with it"
    )
    return Finding(
        "no response",
        f"the reported height moves, the ranges {how} (gain {fit.gain:.2f})",
        "check that the sensor is not stuck, that poses and ranges are of one machine, that this channel is "
        "on the tool that moves, and that the robot applies no demands",
    )
