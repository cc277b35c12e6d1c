"""Write the generated parts of the documentation from what the program declares; `--check` only compares.

docs/reference/parameters.md       the table of parameters
docs/reference/arbiter-states.md   the arbiter's state diagram and its table
docs/reference/cli.md              the page
docs/reference/c-api.md            the page
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from reference_pages import c_page, cli_page
from surffollow.arbiter.diagram import state_diagram, transition_table
from surffollow.config.params import PARAMS
from surffollow.shm.layout_follow import Params
from surffollow.units import format_ns

DOCS = Path(__file__).parents[1] / "docs" / "reference"


def parameters() -> str:
    """The parameters as a Markdown table."""
    lines = ["| parameter | default | from | to | unit | meaning |", "| --- | --- | --- | --- | --- | --- |"]
    for name, spec in PARAMS.items():
        text = format_ns if spec.unit == "ns" else "{:g}".format
        default = spec.choices[int(spec.default)] if spec.choices else text(spec.default)
        low, high = (", ".join(spec.choices), "") if spec.choices else (text(spec.low), text(spec.high))
        unit = "" if spec.unit == "1" else spec.unit
        lines.append(f"| `{name}` | {default} | {low} | {high} | {unit} | {Params.field(name).doc} |")
    return "\n".join(lines) + "\n"


# page, mark, what stands between <!-- MARK: written by tools/write_docs.py --> and <!-- end of MARK -->
PARTS: tuple[tuple[str, str, Callable[[], str]], ...] = (
    ("parameters.md", "parameters", parameters),
    ("arbiter-states.md", "state diagram", state_diagram),
    ("arbiter-states.md", "transitions", transition_table),
)
PAGES: tuple[tuple[str, Callable[[], str]], ...] = (("cli.md", cli_page), ("c-api.md", c_page))


def pages() -> Iterator[tuple[Path, str, str]]:
    """Each page with generated parts: where, as it is, as it should be."""
    for name in dict.fromkeys(page for page, _, _ in PARTS):
        path = DOCS / name
        text = expected = path.read_text(encoding="utf-8")
        for page, mark, make in PARTS:
            if page == name:
                begin, end = f"<!-- {mark}: written by tools/write_docs.py -->\n", f"<!-- end of {mark} -->"
                head, rest = expected.split(begin, 1)
                expected = head + begin + make() + end + rest.split(end, 1)[1]
        yield path, text, expected
    for name, whole in PAGES:
        path = DOCS / name
        yield path, path.read_text(encoding="utf-8") if path.exists() else "", whole()


if __name__ == "__main__":
    stale = [(path, expected) for path, text, expected in pages() if text != expected]
    if "--check" in sys.argv[1:]:
        sys.exit("\n".join(f"docs/reference/{path.name} is out of date" for path, _ in stale) or 0)
    for path, expected in stale:
        path.write_text(expected, encoding="utf-8")
