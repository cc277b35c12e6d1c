"""Cells in which the limit is near what a method reached, so that a reader sees what is out of reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

from surffollow.benchmark.comparison import (
    EXEMPT_SHARE,
    HALF,
    LEAD_M,
    OURS,
    CellKey,
    Row,
    Table,
    cell_name,
)
from surffollow.benchmark.methods import LIMIT

NEAR_SHARE = 0.4  # cells with a limit above this share of the best oracle are listed


def beyond_half(limit: Row, own_at_0: Row) -> bool:
    """True when the limit leaves less than a fifth of what lead 50 is permitted of the error at lead 0."""
    return bool(limit["rms_m"] > EXEMPT_SHARE * HALF * own_at_0["rms_m"])


def near_the_limit(rows: Sequence[Row]) -> list[Row]:
    """Cells in which the limit exceeds 0.4 × what a method reached, and whether they are exempt.

    Returns
    -------
    list of dict
        `criterion`, `cell`, `limit_m`, `reference_m` (best oracle, or own error at lead 0), `ours_m`,
        `ours_over_limit` and `exempt`
    """
    table = Table(rows)
    found: list[Row] = []

    def add(criterion: str, key: CellKey, reference_m: float, exempt: bool) -> None:
        limit_m, ours = table.cells[key][LIMIT]["rms_m"], table.cells[key].get(OURS)
        ours_m = ours["rms_m"] if ours else math.nan
        head = {
            "criterion": criterion,
            "cell": cell_name(key),
            "limit_m": limit_m,
            "reference_m": reference_m,
        }
        ratio = ours_m / max(limit_m, 1e-12)
        found.append({**head, "ours_m": ours_m, "ours_over_limit": ratio, "exempt": exempt})

    for key, cell in table.cells.items():
        best, at_0 = table.best_oracle(key), table.cells.get((key[0], key[1], 0.0, key[3]), {}).get(OURS)
        if LIMIT not in cell:
            continue
        if key[2] == 0.0 and best and table.limit_share(key) > NEAR_SHARE:
            add("RMS over best oracle", key, best["rms_m"], table.exempt(key))
        if key[2] == LEAD_M and at_0 and beyond_half(cell[LIMIT], at_0):
            add("lead 50 mm, RMS over own at lead 0", key, at_0["rms_m"], True)
    return found


def near_text(found: Sequence[Row], markdown: bool = False) -> str:
    """Return the cells of `near_the_limit` as lines for the terminal, or as a Markdown table [mm]."""
    heads = ("criterion", "cell", "limit", "reference", "ours", "ours/limit", "")
    rows = [
        (
            r["criterion"],
            r["cell"],
            *(f"{1e3 * r[name]:.3f}" for name in ("limit_m", "reference_m", "ours_m")),
            f"{r['ours_over_limit']:.2f}",
            "exempt" if r["exempt"] else "evaluated",
        )
        for r in found
    ]
    title = f"Limit above {NEAR_SHARE:g} × the reference: best oracle, or own error at lead 0 [mm]"
    if markdown:
        lines = [
            f"### {title}\n",
            "| " + " | ".join(heads) + " |",
            "| --- | --- |" + " ---: |" * 4 + " --- |",
        ]
        return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"
    widths = [max(len(row[i]) for row in [heads, *rows]) for i in range(len(heads))]
    shown = ["  ".join(f"{v:<{w}}" for v, w in zip(row, widths)).rstrip() for row in [heads, *rows]]
    return "\n".join([title, *shown])
