"""Choice of a correction by left-out spots: what they do not confirm is not applied (§3.4-3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.calibration import CalibrationMatrix
from surffollow.scan.checks import Floats, real_array
from surffollow.scan.polar import PolarCorrection

MODELS = ("none", "constant", "plane", "triangles")  # from the fewest free numbers to the most
GAIN = 0.9  # a richer model must leave less than this part of the simpler one's held-out residual


@dataclass(frozen=True)
class ChosenMatrix:
    """A vertical correction and what speaks for it.

    Attributes
    ----------
    model : str                          one of `MODELS`; "none": the spots confirm no correction
    matrix : CalibrationMatrix           zero for "none"; `left_out_m` are the model's own residuals
    held_out_rms_m : dict[str, float]    RMS residual [m] of left-out spots by model, over the same spots
    """

    model: str
    matrix: CalibrationMatrix
    held_out_rms_m: dict[str, float]


def choose_matrix(
    spots: ArrayLike,
    *,
    model: str = "auto",
    grid_m: float = 0.1,
    region: Sequence[float] | None = None,
    outside: str = "nearest",
) -> ChosenMatrix:
    """Fit no correction, a constant, a plane and the paper's triangles; take what left-out spots confirm.

    Parameters
    ----------
    spots : (n, 3) float [m]     see `CalibrationMatrix.fit`, as the three last
    model : str                  "auto", or one of `MODELS` to force it

    Raises
    ------
    ScanInputError
        as `CalibrationMatrix.fit`, or no such model

    Notes
    -----
    Residuals are leave-one-out. The triangles pass through every spot and so carry each spot's error of
    contact and map into the scan; a constant of n spots carries 1/√n of it. From the simplest model on, a
    richer one is taken when its held-out RMS is below `GAIN` times that of the one taken so far.
    """
    if model != "auto" and model not in MODELS:
        raise ScanInputError(f"model is '{model}'; expected auto or one of {', '.join(MODELS)}")
    full = CalibrationMatrix.fit(spots, grid_m=grid_m, region=region, outside=outside)
    given = full.spots_m
    fitted, left = {"triangles": given[:, 2]}, {"triangles": full.left_out_m}
    for name in MODELS[:-1]:
        fitted[name], left[name] = _linear(given, name)
    surrounded = np.isfinite(full.left_out_m)
    scored = surrounded if int(surrounded.sum()) >= 3 else np.ones(len(given), np.bool_)
    rms = {name: _rms(left[name][scored]) for name in MODELS}
    if not np.isfinite(rms["triangles"]):  # too few spots surround another one
        rms["triangles"] = float("inf")
    chosen = _simplest(rms) if model == "auto" else model
    if chosen == "triangles":
        made = full
    else:
        smooth = np.column_stack([given[:, :2], fitted[chosen]])
        made = CalibrationMatrix.fit(smooth, grid_m=grid_m, region=region, outside=outside)
        made = replace(made, spots_m=given, left_out_m=left[chosen])
    return ChosenMatrix(chosen, made, rms)


def choose_polar(
    commanded_m: ArrayLike, measured_m: ArrayLike, base_m: Sequence[float]
) -> tuple[PolarCorrection, dict[str, float]]:
    """Fit equations 8 and 9; keep the fit only when left-out spots confirm it.

    Parameters
    ----------
    commanded_m, measured_m, base_m : see `PolarCorrection.fit`

    Returns
    -------
    PolarCorrection, dict     the fit, or the same without effect; held-out RMS [m] of "none" and "polar"

    Raises
    ------
    ScanInputError
        as `PolarCorrection.fit`
    """
    fit = PolarCorrection.fit(commanded_m, measured_m, base_m)
    a = real_array("commanded_m", commanded_m, (None, None))[:, :2]
    b = real_array("measured_m", measured_m, (None, None))[:, :2]
    rms = {"none": _rms(np.hypot(*(b - a).T)), "polar": float("inf")}
    if len(a) > 3:
        left = np.empty(len(a))
        for k in range(len(a)):
            others = np.arange(len(a)) != k
            one = PolarCorrection.fit(a[others], b[others], base_m)
            left[k] = np.hypot(*(one.apply(b[k : k + 1]) - a[k : k + 1])[0])
        rms["polar"] = _rms(left)
    if rms["polar"] < GAIN * rms["none"]:
        return fit, rms
    return replace(fit, scale=1.0, offset_m=0.0, offset_rad=0.0, residual_m=np.hypot(*(b - a).T)), rms


def _simplest(rms: dict[str, float]) -> str:
    taken = MODELS[0]
    for name in MODELS[1:]:
        if rms[name] < GAIN * rms[taken]:
            taken = name
    return taken


def _linear(spots: Floats, name: str) -> tuple[Floats, Floats]:
    """Values of a linear least-squares model at the spots, and its leave-one-out residuals."""
    n, v = len(spots), spots[:, 2]
    if name == "none":
        return np.zeros(n), v.copy()
    columns = [np.ones(n)] if name == "constant" else [np.ones(n), spots[:, 0], spots[:, 1]]
    basis = np.column_stack(columns)
    hat = basis @ np.linalg.pinv(basis)
    free = 1.0 - np.diag(hat)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(free > 1e-9, (v - hat @ v) / free, np.inf)
    return np.asarray(hat @ v), np.asarray(left)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
