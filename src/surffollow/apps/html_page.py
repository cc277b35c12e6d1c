"""One HTML page with figures and pictures in a single file."""

from __future__ import annotations

import base64
import html
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from surffollow.map.formats.atomic_file import replacing

STYLE = (
    "body{font:15px sans-serif;max-width:75em;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{padding:.2em .8em;text-align:right;border-bottom:1px solid #ccc}"
    "td:first-child,th:first-child{text-align:left}img{max-width:100%}.bad{color:#b00}.wide{overflow-x:auto}"
)
# ending of a key: factor, unit and digits of what is shown
_UNITS = {
    "_m": (1e3, "mm", 1),
    "_mps": (1.0, "m/s", 2),
    "_mps2": (1.0, "m/s²", 2),
    "_m2ps": (1.0, "m²/s", 4),
    "_s": (1.0, "s", 1),
    "_hz": (1.0, "Hz", 2),
    "_rad": (57.29577951308232, "°", 2),
    "_deg": (1.0, "°", 1),
}


class Page:
    """Parts of a page, in order."""

    def __init__(self, title: str, verdict: str, good: bool) -> None:
        self._parts = [
            f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>",
            f"<style>{STYLE}</style><h1>{html.escape(title)}</h1>",
            f"<p{'' if good else ' class=bad'}>{html.escape(verdict)}</p>",
        ]

    def picture(self, draw: Callable[[Path], Any], about: str) -> None:
        """Draw a PNG into a temporary file and take it in."""
        with tempfile.TemporaryDirectory(prefix="surffollow-report-") as folder:
            path = Path(folder) / "picture.png"
            draw(path)
            image = base64.b64encode(path.read_bytes()).decode("ascii")
        self._parts.append(f'<img alt="{html.escape(about)}" src="data:image/png;base64,{image}">')

    def section(self, title: str, text: str = "") -> None:
        """A heading, and a paragraph below it."""
        self._parts.append(f"<h2>{html.escape(title)}</h2>")
        if text:
            self._parts.append(f"<p>{html.escape(text)}</p>")

    def rows(self, rows: Sequence[dict[str, Any]]) -> None:
        """A table of rows that have the same keys."""
        if not rows:
            self._parts.append("<p>none</p>")
            return
        head = "".join(f"<th>{html.escape(_label(str(k)))}</th>" for k in rows[0])
        body = "".join(
            "<tr>" + "".join(f"<td>{_cell(k, v)}</td>" for k, v in r.items()) + "</tr>" for r in rows
        )
        self._parts.append(f"<div class=wide><table><tr>{head}</tr>{body}</table></div>")

    def facts(self, facts: dict[str, Any]) -> None:
        """A table of two columns."""
        body = "".join(
            f"<tr><td>{html.escape(_label(k))}</td><td>{_cell(k, v)}</td></tr>" for k, v in facts.items()
        )
        self._parts.append(f"<table>{body}</table>")

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file, atomically."""
        with replacing(path) as temporary, open(temporary, "w", encoding="utf-8") as out:
            out.write("\n".join(self._parts) + "\n")


def _unit(key: str) -> tuple[str, tuple[float, str, int] | None]:
    for ending, unit in sorted(_UNITS.items(), key=lambda u: -len(u[0])):
        if key.endswith(ending):
            return key.removesuffix(ending), unit
    return key, None


def _label(key: str) -> str:
    name, unit = _unit(key)
    return name.replace("_", " ") + (f" [{unit[1]}]" if unit else "")


def _cell(key: str, value: Any) -> str:
    _, unit = _unit(key)
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value * unit[0]:.{unit[2]}f}" if unit else f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{html.escape(_label(str(k)))} {_cell(key, v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_cell(key, v) for v in value)
    return html.escape(str(value))
