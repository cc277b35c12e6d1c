"""Compare the evaluated follower with the oracles, cell by cell, and make verdicts on the ratios.

Ratios compare RMS errors, both taken as at least 0.1 mm. A cell is exempt where the limit exceeds 0.8 × the
best oracle at lead 0: there a method that knew everything beforehand would gain less than a fifth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from surffollow.benchmark.cell_runs import geometric_mean
from surffollow.benchmark.families import PERIODIC
from surffollow.benchmark.family_profiles import FAMILY_SURFACES
from surffollow.benchmark.methods import BASELINES, LIMIT, ORACLE

OURS = "ours"
FLOOR_M = 0.1e-3
EXEMPT_SHARE = 0.8  # of what a criterion permits: beyond it even full knowledge gains less than a fifth
LEAD_M = 0.05
HALF = 0.5  # of the own error at lead 0 is permitted at lead 50
REPORTED = math.inf  # the bound of a figure without a limit
TUNABLE = tuple(name for name, m in BASELINES.items() if m.tunable)
ORACLES = tuple(name + ORACLE for name in TUNABLE)
WAVE = "kalman-wave"
FIRST = (
    "p",
    "pi",
    "lpf-gate",
    "kalman-ff",
)  # the baselines of figures published before the others were added

Row = dict[str, Any]
CellKey = tuple[str, float, float, str]  # surface, speed, lead, variant


class Verdict(msgspec.Struct, frozen=True):
    """One acceptance criterion: text, figure, bound, and a remark on the source of the figure."""

    criterion: str
    figure: float
    bound: float
    passed: bool
    note: str = ""


class Table:
    """Rows by cell and method, and which oracles count."""

    def __init__(self, rows: Sequence[Row], oracles: Sequence[str] = ORACLES) -> None:
        self.oracles = oracles
        self.cells: dict[CellKey, dict[str, Row]] = {}
        for r in rows:
            key = (r["surface"], r["speed_mps"], r["lead_m"], r.get("variant", ""))
            self.cells.setdefault(key, {})[r["method"]] = r

    def best_oracle(self, key: CellKey) -> Row | None:
        """Row of the oracle with the smallest RMS in a cell."""
        rows = [r for name, r in self.cells.get(key, {}).items() if name in self.oracles]
        return min(rows, key=lambda r: float(r["rms_m"])) if rows else None

    def limit_share(self, key: CellKey) -> float:
        """Limit over the best oracle (at lead 0); NaN when one of them was not run."""
        at_0 = (key[0], key[1], 0.0, key[3])
        best, limit = self.best_oracle(at_0), self.cells.get(at_0, {}).get(LIMIT)
        if best is None or limit is None:
            return math.nan
        return float(limit["rms_m"]) / max(float(best["rms_m"]), 1e-12)

    def exempt(self, key: CellKey) -> bool:
        """True when physics, not the method, decides the cell (evaluated at lead 0)."""
        return self.limit_share(key) > EXEMPT_SHARE

    def where(self, lead_m: float, variant: Callable[[str], bool] = lambda v: v == "") -> list[CellKey]:
        """Cells that count, of one lead and some variants."""
        return [k for k in self.cells if k[2] == lead_m and variant(k[3]) and not self.exempt(k)]


def rms_ratio(a_m: float, b_m: float) -> float:
    return max(a_m, FLOOR_M) / max(b_m, FLOOR_M)


def worst_verdict(criterion: str, bound: float, figures: dict[str, float], note: str = "") -> Verdict:
    """Make a verdict on the greatest of some figures by cell name.

    Parameters
    ----------
    criterion : str  name of the criterion
    bound : float    figures up to it pass
    figures : dict   figure by cell name
    note : str       remark
    """
    if not figures:
        return Verdict(criterion, math.nan, bound, False, "not run")
    cell = max(figures, key=lambda name: figures[name])
    over = sum(not v <= bound for v in figures.values())
    remark = f"worst {cell}; {over} of {len(figures)} over" + (f"; {note}" if note else "")
    return Verdict(criterion, figures[cell], bound, bool(figures[cell] <= bound), remark)


def mean_verdict(
    criterion: str, bound: float, values: Sequence[float], note: str = "", geometric: bool = True
) -> Verdict:
    """Make a verdict on the mean of some figures.

    Parameters
    ----------
    criterion : str   name of the criterion
    bound : float     means up to it pass
    values : sequence of float
    note : str        remark
    geometric : bool  geometric mean; else arithmetic
    """
    if not values:
        return Verdict(criterion, math.nan, bound, False, "not run")
    figure = geometric_mean(values) if geometric else sum(values) / len(values)
    return Verdict(criterion, figure, bound, bool(figure <= bound), note or f"{len(values)} cells")


def cell_name(key: CellKey) -> str:
    return f"{key[0]} {1e3 * key[1]:g} mm/s" + (f" {key[3]}" if key[3] else "")


def ratios_to_oracles(table: Table, keys: Sequence[CellKey]) -> dict[CellKey, float]:
    """Ratio of the evaluated RMS to the best oracle's, by cell."""
    ratios: dict[CellKey, float] = {}
    for key in keys:
        ours, best = table.cells[key].get(OURS), table.best_oracle(key)
        if ours and best:
            ratios[key] = rms_ratio(ours["rms_m"], best["rms_m"])
    return ratios


def of_family(key: CellKey) -> bool:
    """True for a cell on a family of surfaces."""
    return key[0] in FAMILY_SURFACES


def periodic(key: CellKey) -> bool:
    """True for a cell on sines, the chirp, corrugated sheet or furrows."""
    return key[0].startswith("sine") or key[0] == "chirp" or key[0] in PERIODIC


def greatest(ratios: dict[CellKey, float]) -> float:
    return max(ratios.values(), default=math.nan)


def geometric(ratios: dict[CellKey, float]) -> float:
    return geometric_mean(ratios.values())


class Oracles:
    """The table as evaluated, without the wave oracle, and with the first four oracles alone."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.table = Table(rows)
        self.others = {
            f"without {WAVE}": Table(rows, [name for name in ORACLES if name != WAVE + ORACLE]),
            "with the first four oracles": Table(rows, [name + ORACLE for name in FIRST]),
        }

    def ratios(self, keep: Callable[[CellKey], bool], table: Table | None = None) -> dict[CellKey, float]:
        """Ratios to the best oracle at lead 0 of the cells that `keep` takes."""
        at = table or self.table
        return ratios_to_oracles(at, [k for k in at.where(0.0) if keep(k)])

    def note(
        self, keep: Callable[[CellKey], bool], figure: Callable[[dict[CellKey, float]], float], note: str = ""
    ) -> str:
        """The figure with fewer oracles, behind a remark."""
        reported = [f"{figure(self.ratios(keep, t)):.3f} {name}" for name, t in self.others.items()]
        return "; ".join([note] * bool(note) + reported)

    def worst(self, criterion: str, bound: float, keep: Callable[[CellKey], bool], note: str = "") -> Verdict:
        """Verdict on the greatest ratio.

        Parameters
        ----------
        criterion : str  name of the criterion
        bound : float    ratios up to it pass
        keep : callable  which cells count
        note : str       remark
        """
        found = {cell_name(k): v for k, v in self.ratios(keep).items()}
        return worst_verdict(criterion, bound, found, self.note(keep, greatest, note))

    def mean(self, criterion: str, bound: float, keep: Callable[[CellKey], bool], note: str = "") -> Verdict:
        """Verdict on the geometric mean of the ratios.

        Parameters
        ----------
        criterion : str  name of the criterion
        bound : float    means up to it pass
        keep : callable  which cells count
        note : str       remark
        """
        values = list(self.ratios(keep).values())
        count = f"{len(values)} cells" + (f"; {note}" if note else "")
        return mean_verdict(criterion, bound, values, self.note(keep, geometric, count))
