"""One HTML page about a run of the field demonstration: figures, flags and picture in one file."""

from __future__ import annotations

import os
from typing import Any

from surffollow.apps.field_demo import Demonstration
from surffollow.apps.html_page import Page
from surffollow.scan.path import flag_counts


def write_report(path: str | os.PathLike[str], made: Demonstration, tables: dict[str, Any]) -> None:
    """Write the page, atomically.

    Parameters
    ----------
    path : of the HTML file
    made : Demonstration
    tables : {"elements": rows, "filters": rows}, either of them or none

    Raises
    ------
    ScanFileError
        without matplotlib
    """
    from surffollow.apps.field_pictures import draw_field

    f = made.figures
    failed = f["failures"]
    page = Page(
        f"Scan of {f['ground']} ground, seed {f['seed']}",
        "all limits met" if not failed else "; ".join(failed),
        not failed,
    )
    page.picture(lambda p: draw_field(p, made), "scene, gap, acceleration, signal")
    page.section("Run", f"gap {1e3 * f['gap_m']:.0f} mm, {f['speed_mps']} m/s; errors of the gap in mm")
    page.rows([{"motion": name} | f[name] for name in ("unshaped", "shaped")])
    page.section("Calibration")
    page.facts(f["calibration"])
    page.section("Line of 2.4 m")
    page.rows(
        [
            {"shaper": n} | {k: v for k, v in r.items() if not isinstance(v, dict)}
            for n, r in f["line"].items()
        ]
    )
    page.section("Target")
    page.facts({k: f["target"][k] for k in ("error_m", "error_in_map_m", "peak_error_m", "depth_m")})
    page.section("Flags of the path (samples)")
    page.rows([flags] if (flags := _flags(made)) else [])
    for name, rows in tables.items():
        page.section(name.capitalize(), f"means over {rows[0].get('seeds', 1)} seeds" if rows else "")
        page.rows(rows)
    page.write(path)


def _flags(made: Demonstration) -> dict[str, int]:
    return {k: v for k, v in flag_counts(made.shaped.desired.flags).items() if v}
