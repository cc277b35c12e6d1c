"""Write the generated part of docs/configuration.md from the table of parameters; `--check` only compares."""

from __future__ import annotations

import sys
from pathlib import Path

from surffollow.config.params import PARAMS
from surffollow.shm.layout_follow import Params

PAGE = Path(__file__).parents[1] / "docs" / "configuration.md"
BEGIN, END = "<!-- parameters: written by tools/write_docs.py -->\n", "<!-- end of parameters -->"


def table() -> str:
    """The parameters as a Markdown table."""
    lines = ["| parameter | default | from | to | unit | meaning |", "| --- | --- | --- | --- | --- | --- |"]
    for name, spec in PARAMS.items():
        default = spec.choices[int(spec.default)] if spec.choices else f"{spec.default:g}"
        low, high = (", ".join(spec.choices), "") if spec.choices else (f"{spec.low:g}", f"{spec.high:g}")
        unit = "" if spec.unit == "1" else spec.unit
        lines.append(f"| `{name}` | {default} | {low} | {high} | {unit} | {Params.field(name).doc} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page as it should be."""
    text = PAGE.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN, 1)
    return head + BEGIN + table() + END + rest.split(END, 1)[1]


if __name__ == "__main__":
    wanted = page()
    if "--check" in sys.argv[1:]:
        sys.exit(0 if wanted == PAGE.read_text(encoding="utf-8") else "docs/configuration.md is out of date")
    PAGE.write_text(wanted, encoding="utf-8")
