"""Figures of a demonstration: what the map holds, what is wrong, and the table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.client import Client
from surffollow.client.map_reader import copy_map
from surffollow.shm import map_layout as ml
from surffollow.units import format_ns


def map_figures(client: Client, path: Path) -> dict[str, Any]:
    """Copy the live map, keep its heights in `path` (NPZ), and count its grids."""
    header, pairs = copy_map(client, 5.0)
    h = header[0]
    nx, ny = int(h["nx"]), int(h["ny"])
    heights = pairs["h"].reshape(-1)[: nx * ny].reshape(ny, nx)
    known = heights != ml.UNKNOWN
    heights_m = np.where(known, heights * float(h["quantum_m"]) + float(h["datum_m"]), np.nan)
    np.savez_compressed(
        path,
        heights_m=heights_m.astype(np.float32),
        x0_m=float(h["x0_m"]),
        y0_m=float(h["y0_m"]),
        grid_m=float(h["grid_m"]),
    )
    return {"grids_known": int(known.sum()), "grids": nx * ny, "grid_m": float(h["grid_m"])}


def verdict(
    result: dict[str, Any], rms_limit_m: float, rolling_limit_m: float, angle_limit_deg: float = math.inf
) -> list[str]:
    """Failed checks.

    Parameters
    ----------
    result : dict            figures of the demonstration
    rms_limit_m, rolling_limit_m : float [m]  limits of the stand-off RMS, and of that on rolling ground
    angle_limit_deg : float  limit of the angle RMS
    """
    failures = []
    rms = result["standoff_rms_m"]
    if rms is None:
        failures.append("nothing scored: the path ended before the score begins; ask for more --seconds")
    angle = result.get("angle_rms_deg")
    if angle is not None and not angle <= angle_limit_deg:
        failures.append(f"angle RMS {angle:.2f} degrees > {angle_limit_deg:g} degrees")
    rolling = result["standoff_rms_rolling_m"]
    if rms is not None and not rms <= rms_limit_m:
        failures.append(f"stand-off RMS {rms * 1e3:.2f} mm > {rms_limit_m * 1e3:g} mm")
    if result["moving_s"] < result["seconds"] - 0.5:
        failures.append(f"the robot moved for {result['moving_s']:.1f} s of {result['seconds']:g} s")
    if rms is not None and rolling is None and result["seconds"] >= 10.0:
        failures.append("no rolling ground was passed, so following on it was not measured")
    if rolling is not None and not rolling <= rolling_limit_m:
        failures.append(
            f"stand-off RMS on rolling ground {rolling * 1e3:.2f} mm > {rolling_limit_m * 1e3:g} mm"
        )
    if not result["replay_identical"]:
        failures.append("the replay differs from the live run")
    if result["grids_known"] == 0:
        failures.append("no grid was mapped")
    if result["samples_lost"]:
        failures.append(f"{result['samples_lost']} samples never reached the map")
    return failures


def table(result: dict[str, Any]) -> str:
    """The figures as text."""

    def mm(name: str) -> str:
        return "nothing scored" if result[name] is None else f"{result[name] * 1e3:.2f} mm"

    def degrees(name: str) -> str:
        return "nothing scored" if result[name] is None else f"{result[name]:.2f} degrees"

    rolling = result["standoff_rms_rolling_m"]
    along = " along the tool's axis" if "sensors" in result else ""
    rows = [
        (f"stand-off RMS{along}", mm("standoff_rms_m")),
        ("  on rolling parts", "-" if rolling is None else f"{rolling * 1e3:.2f} mm"),
        ("stand-off peak", mm("standoff_peak_m")),
        ("path", f"{result['path_m']:.2f} m in {result['moving_s']:.1f} s"),
        ("speed", f"{result['speed_mps'] * 1e3:g} mm/s"),
        ("cycles", f"{result['cycles']} ({result['overruns']} overruns)"),
        (
            "lateness p50 / p99",
            f"{format_ns(result['lateness_p50_ns'])} / {format_ns(result['lateness_p99_ns'])}",
        ),
        ("work p50 / p99", f"{format_ns(result['work_p50_ns'])} / {format_ns(result['work_p99_ns'])}"),
        (
            "grids mapped",
            f"{result['grids_known']} of {result['grids']}, {result['grid_m'] * 1e3:.3g} mm wide",
        ),
        ("recorded", f"{result['recorded_cycles']} cycles, {result['recorded_lost']} lost"),
        (
            "replay",
            f"{'identical, bit for bit' if result['replay_identical'] else 'DIFFERENT'}, "
            f"{result['replay_cycles_per_s'] / 1e6:.1f} million cycles/s",
        ),
    ]
    if "sensors" in result:
        rows[1:2] = []
        rows[2:2] = [
            ("angle to the normal, RMS", degrees("angle_rms_deg")),
            ("angle to the normal, peak", degrees("angle_peak_deg")),
            ("steepest ground", degrees("tilt_peak_deg")),
            ("sensors", f"{result['sensors']}"),
        ]
    width = max(len(r[0]) for r in rows)
    return "\n".join(f"  {name:<{width}}  {value}" for name, value in rows)
