"""The table of symbols of the page on following names fields that the follower has."""

from __future__ import annotations

import re
from pathlib import Path

from surffollow.shm.layout_adaptive import AdaptiveState

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "following.md"
FORECAST = ROOT / "src" / "surffollow" / "forecast"


def fields_of_state() -> set[str]:
    """`record.field` of all records of the default follower."""
    return {f"{r.name}.{f.name}" for r in AdaptiveState.FIELDS for f in r.nested.FIELDS}


def test_symbols_are_fields_or_names_of_the_code():
    table = PAGE.read_text(encoding="utf-8").partition("## Symbols")[2].partition("\n## ")[0]
    cells = [line.rstrip(" |").rpartition(" | ")[2] for line in table.splitlines() if line.startswith("| ")]
    named = {name for cell in cells[2:] for name in re.findall(r"`([^`]+)`", cell)}
    records = {name for name in named if "." in name}
    assert len(records) > 20
    assert records <= fields_of_state()
    source = "".join(p.read_text(encoding="utf-8") for p in FORECAST.rglob("*.py"))
    assert not [name for name in named - records if not re.search(rf"\b{name}\b", source)]
