"""A figure in a document that names its constant, `50 ms<!-- service.memory.X_NS -->`, equals it."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from surffollow.units import parse_quantity

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("**/*.md"))]
MARKED = re.compile(
    r"(\d[\d.,·^e-]*(?:\s?(?:[µmnk]?[ms]|%|kHz|Hz|rad|deg|B|KiB|MiB))?)<!-- ([\w.]+\.[A-Z]\w*(?:\.\w+)?) -->"
)
NAMED = re.compile(r"<!-- [\w.]+\.[A-Z]\w*(?:\.\w+)? -->")
# the unit of a constant, by the end of its name
UNITS = {"NS": "ns", "S": "s", "M": "m", "RAD": "rad", "HZ": "Hz", "BYTES": "B", "MPS": "m/s"}


def figures(text: str) -> list[tuple[str, str]]:
    """Figures of a page outside of its code blocks, and the constants that they repeat."""
    prose = re.sub(r"^([ ]*)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    found = MARKED.findall(prose)
    assert len(found) == len(NAMED.findall(prose)), "a constant is named behind something that is no figure"
    return found


def value_of(constant: str) -> float:
    """The constant `package.module.NAME` of the program, or the default of a parameter `….PARAMS.name`."""
    parts = constant.split(".")
    n = next(k for k, part in enumerate(parts) if part[0].isupper())
    value: Any = importlib.import_module(".".join(("surffollow", *parts[:n])))
    for part in parts[n:]:
        value = value[part] if isinstance(value, dict) else getattr(value, part)
    return float(getattr(value, "default", value))


def said(figure: str, constant: str) -> float:
    """The number that a figure says, in the unit of the constant."""
    unit = UNITS.get(constant.rpartition("_")[2].upper(), "1")
    return parse_quantity(figure.replace(",", ""), unit, bare=True)


@pytest.mark.parametrize("page", [p for p in PAGES if NAMED.search(p.read_text())], ids=lambda p: p.name)
def test_a_figure_equals_the_constant_that_it_names(page):
    for figure, constant in figures(page.read_text()):
        assert said(figure, constant) == pytest.approx(value_of(constant), rel=1e-9), (figure, constant)


def test_figures_are_read_in_the_unit_of_their_constant():
    (found,) = figures("every 0.2 s<!-- hw.polled.RETRY_S -->.\n```\n7 s<!-- hw.polled.RETRY_S -->\n```\n")
    assert said(*found) == value_of(found[1])
    assert said("200 ms", found[1]) == pytest.approx(value_of(found[1]))
    assert said("16,384", "x.y.N_BYTES") == 16384.0


def test_a_constant_behind_a_word_is_refused():
    with pytest.raises(AssertionError, match="no figure"):
        figures("half a second<!-- hw.polled.SILENCE_S -->")
