"""One HTML page about a run of the field demonstration: figures, flags and picture in one file."""

from __future__ import annotations

import base64
import html
import os
import tempfile
from pathlib import Path
from typing import Any

from surffollow.live.field_demo import Demonstration
from surffollow.map.atomic_file import replacing
from surffollow.scan.path import flag_counts

STYLE = (
    "body{font:15px sans-serif;max-width:75em;margin:2em auto}td,th{padding:.2em .8em;text-align:right;"
    "border-bottom:1px solid #ccc}td:first-child,th:first-child{text-align:left}img{max-width:100%}"
)


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
    from surffollow.live.field_pictures import draw_field

    with tempfile.TemporaryDirectory(prefix="surffollow-report-") as folder:
        picture = Path(folder) / "field.png"
        draw_field(picture, made)
        image = base64.b64encode(picture.read_bytes()).decode("ascii")
    f = made.figures
    failed = f["failures"]
    verdict = "all bars met" if not failed else "; ".join(failed)
    flags = {k: v for k, v in flag_counts(made.shaped.wanted.flags).items() if v}
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>Scan report</title><style>{STYLE}</style>",
        f"<h1>Scan of {html.escape(f['ground'])} ground, seed {f['seed']}</h1><p>{html.escape(verdict)}</p>",
        f'<img alt="scene, gap, acceleration, signal" src="data:image/png;base64,{image}">',
        "<h2>Run</h2>",
        _rows([{"motion": name} | f[name] for name in ("unshaped", "shaped")]),
        "<h2>Calibration</h2>",
        _rows([f["calibration"]]),
        "<h2>Line of 2.4 m</h2>",
        _rows(
            [
                {"shaper": n} | {k: v for k, v in r.items() if not isinstance(v, dict)}
                for n, r in f["line"].items()
            ]
        ),
        "<h2>Target</h2>",
        _rows([{k: f["target"][k] for k in ("error_m", "error_in_map_m", "height")}]),
        "<h2>Flags of the path (samples)</h2>",
        _rows([flags]) if flags else "<p>none</p>",
    ]
    for name, rows in tables.items():
        parts += [f"<h2>{html.escape(name.capitalize())}</h2>", _rows(rows)]
    with replacing(path) as temporary, open(temporary, "w", encoding="utf-8") as out:
        out.write("\n".join(parts) + "\n")


def _rows(rows: list[dict[str, Any]]) -> str:
    """A table of rows that have the same keys."""
    head = "".join(f"<th>{html.escape(str(k))}</th>" for k in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{_cell(v)}</td>" for v in r.values()) + "</tr>" for r in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))
