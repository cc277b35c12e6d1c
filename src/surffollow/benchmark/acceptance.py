"""The criteria that the default follower must meet, computed from the rows of one run.

Ratios compare RMS errors, both taken as at least 0.1 mm (so is the σ that an excursion is held against).
A cell is exempt from a comparison with an oracle where the limit exceeds 0.8 × the best oracle at lead 0:
there a method that knew everything beforehand would gain less than a fifth. A figure that could not be
computed counts as short. Criteria without a bound are reported only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.families import FAMILY_SURFACES, PERIODIC
from surffollow.benchmark.methods import BASELINES, LIMIT, ORACLE
from surffollow.benchmark.runner import geometric_mean

JUDGED = "ours"
FLOOR_M = 0.1e-3
EXEMPT_SHARE = 0.8  # of what a criterion permits: beyond it even full knowledge gains less than a fifth
NEAR_SHARE = 0.4  # cells with a limit above this share of the best oracle are listed
FAST_MPS = 0.3  # above: the bar of 400 mm/s
STEP_SCORED_MPS = 0.2
LEAD_M = 0.05
HALF = 0.5  # of the own error at lead 0 is permitted at lead 50
NORMAL_RATIO = 1.2
OSCILLATION_GROWTH = 1.5
REPORTED = math.inf  # the bound of a figure that is not judged
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
    """One bar: what it is, its figure, the bound, and a remark on where the figure comes from."""

    bar: str
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
        """True when physics, not the method, decides the cell (judged at lead 0)."""
        return self.limit_share(key) > EXEMPT_SHARE

    def where(self, lead_m: float, variant: Callable[[str], bool] = lambda v: v == "") -> list[CellKey]:
        """Cells that count, of one lead and some variants."""
        return [k for k in self.cells if k[2] == lead_m and variant(k[3]) and not self.exempt(k)]


def _ratio(a_m: float, b_m: float) -> float:
    return max(a_m, FLOOR_M) / max(b_m, FLOOR_M)


def _worst(bar: str, bound: float, figures: dict[str, float], note: str = "") -> Verdict:
    """Make a verdict on the greatest of some figures by cell name."""
    if not figures:
        return Verdict(bar, math.nan, bound, False, "not run")
    cell = max(figures, key=lambda name: figures[name])
    over = sum(not v <= bound for v in figures.values())
    remark = f"worst {cell}; {over} of {len(figures)} over" + (f"; {note}" if note else "")
    return Verdict(bar, figures[cell], bound, bool(figures[cell] <= bound), remark)


def _mean(bar: str, bound: float, values: Sequence[float], note: str = "", geometric: bool = True) -> Verdict:
    if not values:
        return Verdict(bar, math.nan, bound, False, "not run")
    figure = geometric_mean(values) if geometric else sum(values) / len(values)
    return Verdict(bar, figure, bound, bool(figure <= bound), note or f"{len(values)} cells")


def _name(key: CellKey) -> str:
    return f"{key[0]} {1e3 * key[1]:g} mm/s" + (f" {key[3]}" if key[3] else "")


def _against_oracles(table: Table, keys: Sequence[CellKey]) -> dict[CellKey, float]:
    """Ratio of the judged RMS to the best oracle's, by cell."""
    ratios: dict[CellKey, float] = {}
    for key in keys:
        ours, best = table.cells[key].get(JUDGED), table.best_oracle(key)
        if ours and best:
            ratios[key] = _ratio(ours["rms_m"], best["rms_m"])
    return ratios


def of_family(key: CellKey) -> bool:
    """True for a cell on a family of surfaces."""
    return key[0] in FAMILY_SURFACES


def periodic(key: CellKey) -> bool:
    """True for a cell on sines, the chirp, corrugated sheet or furrows."""
    return key[0].startswith("sine") or key[0] == "chirp" or key[0] in PERIODIC


def _greatest(ratios: dict[CellKey, float]) -> float:
    return max(ratios.values(), default=math.nan)


def _geometric(ratios: dict[CellKey, float]) -> float:
    return geometric_mean(ratios.values())


class _Oracles:
    """The table as judged, without the wave oracle, and with the first four oracles alone."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.table = Table(rows)
        self.others = {
            f"without {WAVE}": Table(rows, [name for name in ORACLES if name != WAVE + ORACLE]),
            "with the first four oracles": Table(rows, [name + ORACLE for name in FIRST]),
        }

    def ratios(self, keep: Callable[[CellKey], bool], table: Table | None = None) -> dict[CellKey, float]:
        """Ratios to the best oracle at lead 0 of the cells that `keep` takes."""
        at = table or self.table
        return _against_oracles(at, [k for k in at.where(0.0) if keep(k)])

    def note(
        self, keep: Callable[[CellKey], bool], figure: Callable[[dict[CellKey, float]], float], note: str = ""
    ) -> str:
        """The figure with fewer oracles, behind a remark."""
        told = [f"{figure(self.ratios(keep, t)):.3f} {name}" for name, t in self.others.items()]
        return "; ".join([note] * bool(note) + told)

    def worst(self, bar: str, bound: float, keep: Callable[[CellKey], bool], note: str = "") -> Verdict:
        """Verdict on the greatest ratio."""
        found = {_name(k): v for k, v in self.ratios(keep).items()}
        return _worst(bar, bound, found, self.note(keep, _greatest, note))

    def mean(self, bar: str, bound: float, keep: Callable[[CellKey], bool], note: str = "") -> Verdict:
        """Verdict on the geometric mean of the ratios."""
        values = list(self.ratios(keep).values())
        count = f"{len(values)} cells" + (f"; {note}" if note else "")
        return _mean(bar, bound, values, self.note(keep, _geometric, count))


def _lead_0(oracles: _Oracles) -> list[Verdict]:
    def slow(key: CellKey) -> bool:
        return key[1] < FAST_MPS

    def step(key: CellKey) -> bool:
        return key[0] == "step" and key[1] < STEP_SCORED_MPS

    def smooth(key: CellKey) -> bool:
        return key[0].startswith("sine") or key[0] == "flat"

    others = _greatest(oracles.ratios(lambda k: not of_family(k) and slow(k) and not step(k)))
    return [
        oracles.worst(
            "lead 0, RMS over best oracle, up to 200 mm/s",
            1.10,
            lambda k: not of_family(k) and slow(k),
            f"{others:.3f} without slow steps",
        ),
        oracles.worst(
            "lead 0, RMS over best oracle, 400 mm/s", 1.20, lambda k: not of_family(k) and not slow(k)
        ),
        oracles.mean("lead 0, geometric mean, all", 0.84, lambda k: not of_family(k), "aim 0.75"),
        oracles.mean(
            "lead 0, geometric mean, without sines and flat",
            0.95,
            lambda k: not of_family(k) and not smooth(k),
        ),
        oracles.mean(
            "families, not periodic, geometric mean",
            1.01,
            lambda k: of_family(k) and not periodic(k),
            "aim 0.97",
        ),
        oracles.worst(
            "families, not periodic, RMS over best oracle, up to 200 mm/s",
            1.15,
            lambda k: of_family(k) and not periodic(k) and slow(k),
        ),
        oracles.worst(
            "families, not periodic, RMS over best oracle, 400 mm/s",
            1.25,
            lambda k: of_family(k) and not periodic(k) and not slow(k),
        ),
        oracles.mean("families, with the periodic ones, geometric mean", REPORTED, of_family),
        oracles.mean("all periodic surfaces, geometric mean", REPORTED, periodic),
        oracles.mean(
            "all surfaces that are not periodic, geometric mean", REPORTED, lambda k: not periodic(k)
        ),
        oracles.mean("all surfaces, geometric mean", REPORTED, lambda _: True),
    ]


def _accelerations(
    table: Table, lead_m: float, methods: Sequence[str]
) -> tuple[dict[CellKey, float], dict[CellKey, float]]:
    """Demand acceleration over that of the calmest good method, and over that of the best, by cell.

    A method of `methods` is good when its RMS is within 1.1 × that of the best of them.
    """
    ratios: dict[CellKey, float] = {}
    mild: dict[CellKey, float] = {}
    for key in table.where(lead_m):
        ours = table.cells[key].get(JUDGED)
        rows = [r for name, r in table.cells[key].items() if name in methods]
        if not ours or not rows:
            continue
        best = min(rows, key=lambda r: float(r["rms_m"]))
        good = [r["demand_accel_mps2"] for r in rows if r["rms_m"] <= 1.1 * best["rms_m"]]
        ratios[key] = ours["demand_accel_mps2"] / max(min(good), 1e-9)
        mild[key] = ours["demand_accel_mps2"] / max(best["demand_accel_mps2"], 1e-9)
    return ratios, mild


def _acceleration(
    table: Table, start: str, lead_m: float, methods: Sequence[str], mean: float, each: float
) -> list[Verdict]:
    """Demand acceleration over the calmest method among those within 1.1 × the best one's RMS.

    The remarks give the milder reading too: over the method that is best by RMS, calm or not.
    """
    ratios, mild = _accelerations(table, lead_m, methods)
    worst = max(mild, key=lambda key: mild[key], default=None)
    told_mean = told_each = ""
    if worst:
        own = [v for k, v in ratios.items() if not of_family(k)]
        told_mean = f"{len(mild)} cells; {sum(mild.values()) / len(mild):.3f} over the best by RMS"
        told_mean += f"; {sum(own) / len(own):.3f} without the families" if own else ""
        told_each = f"{mild[worst]:.3f} over the best by RMS, {_name(worst)}"
    return [
        _mean(f"{start}, mean", mean, list(ratios.values()), told_mean, geometric=False),
        _worst(f"{start}, each", each, {_name(k): v for k, v in ratios.items()}, told_each),
    ]


def _lead_50(table: Table, conditions: Conditions) -> list[Verdict]:
    own: dict[CellKey, float] = {}
    bound: dict[CellKey, float] = {}
    for key, rows in table.cells.items():
        ours, limit = rows.get(JUDGED), rows.get(LIMIT)
        at_0 = table.cells.get((key[0], key[1], 0.0, key[3]), {}).get(JUDGED)
        if key[2] != LEAD_M or key[3] or not ours or not limit or not at_0:
            continue
        if key[0] == "sine-100" and key[1] >= FAST_MPS:
            continue
        small = ours["rms_m"] <= FLOOR_M
        if not _beyond_half(limit, at_0):
            own[key] = 0.0 if small else ours["rms_m"] / at_0["rms_m"]
        allowed = 1.5 * limit["rms_m"] + 0.8 * conditions.sensor.sigma_m
        bound[key] = ours["rms_m"] / max(allowed, FLOOR_M)

    def judged(bar: str, most: float, figures: dict[CellKey, float]) -> Verdict:
        families = {k: v for k, v in figures.items() if of_family(k)}
        worst = max(families, key=lambda k: families[k], default=None)
        note = f"families, not judged: worst {families[worst]:.3f}, {_name(worst)}" if worst else ""
        return _worst(bar, most, {_name(k): v for k, v in figures.items() if not of_family(k)}, note)

    return [
        judged("lead 50 mm, RMS over own at lead 0", HALF, own),
        judged("lead 50 mm, RMS over 1.5·limit + 0.8·σ", 1.0, bound),
    ]


def _beyond_half(limit: Row, own_at_0: Row) -> bool:
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
        limit_m, ours = table.cells[key][LIMIT]["rms_m"], table.cells[key].get(JUDGED)
        ours_m = ours["rms_m"] if ours else math.nan
        head = {"criterion": criterion, "cell": _name(key), "limit_m": limit_m, "reference_m": reference_m}
        ratio = ours_m / max(limit_m, 1e-12)
        found.append({**head, "ours_m": ours_m, "ours_over_limit": ratio, "exempt": exempt})

    for key, cell in table.cells.items():
        best, at_0 = table.best_oracle(key), table.cells.get((key[0], key[1], 0.0, key[3]), {}).get(JUDGED)
        if LIMIT not in cell:
            continue
        if key[2] == 0.0 and best and table.limit_share(key) > NEAR_SHARE:
            add("RMS over best oracle", key, best["rms_m"], table.exempt(key))
        if key[2] == LEAD_M and at_0 and _beyond_half(cell[LIMIT], at_0):
            add("lead 50 mm, RMS over own at lead 0", key, at_0["rms_m"], True)
    return found


def _sweeps(table: Table) -> list[Verdict]:
    late: dict[str, float] = {}
    for key in table.where(0.0, lambda v: v.startswith("latency=")):
        ours, kalman = table.cells[key].get(JUDGED), table.cells[key].get("kalman-ff" + ORACLE)
        if ours and kalman:
            late[_name(key)] = _ratio(ours["rms_m"], kalman["rms_m"])
    verdicts = [_worst("latency 0-300 ms, RMS over kalman-ff tuned for it", 1.15, late)]
    for factor, bound in ((0.7, 0.90), (1.5, 1.0)):
        ratios = _against_oracles(table, table.where(0.0, lambda v, f=factor: v == f"tau×{f:g}"))  # type: ignore[misc]
        text = f"plant τ × {factor:g} unknown to it, geometric mean over oracles that know"
        verdicts.append(_mean(text, bound, list(ratios.values())))
    return verdicts


def _trials(trials: Sequence[Row], conditions: Conditions) -> list[Verdict]:
    def of(kind: str, method: str = JUDGED) -> list[Row]:
        return [t for t in trials if t["trial"] == kind and t["method"] == method]

    def label(t: Row) -> str:
        return " ".join(str(v) for v in (t["surface"], f"{1e3 * t['speed_mps']:g} mm/s", t["case"]) if v)

    again: dict[str, float] = {}
    for t in of("second-pass"):
        allowed = max(0.4 * t["first_m"], 1.15 * t["limit_m"], 0.4 * conditions.sensor.sigma_m)
        again[label(t)] = t["second_m"] / allowed
    gain = geometric_mean(t["second_m"] / t["first_m"] for t in of("second-pass"))
    verdicts = [_worst("second pass, RMS over its bound", 1.0, again, f"mean {gain:.2f} of first pass")]

    hold = {t["case"]: t["peak_m"] for t in of("dropout", "hold-policy")}
    slide = {t["case"]: t["peak_m"] for t in of("dropout", "extrapolate-policy")}
    ours = {t["case"]: t["peak_m"] for t in of("dropout")}
    worse = {c: _ratio(v, max(hold[c], slide[c])) for c, v in ours.items()}
    verdicts.append(_worst("drop-outs, peak over the worse pure policy", 1.0, worse))
    if ours:
        better = min(sum(hold.values()), sum(slide.values()))
        means = [1e3 * sum(peaks.values()) / len(peaks) for peaks in (ours, hold, slide)]
        text = "{:.2f} mm; hold {:.2f}, extrapolate {:.2f}".format(*means)
        ratio = sum(ours.values()) / better
        verdicts.append(
            Verdict("drop-outs, mean peak over the better policy", ratio, 0.85, ratio <= 0.85, text)
        )
    for case in ("slot", "glitch"):
        rows = [t for t in of("excursion") if t["case"] == case]
        moved = {label(t): t["worst_excursion_m"] / max(t["sigma_m"], FLOOR_M) for t in rows}
        most = max((t["worst_excursion_m"] for t in rows), default=math.nan)
        verdicts.append(
            _worst(f"{case}: demand excursion over σ of the estimate", 1.0, moved, f"{1e3 * most:.3f} mm")
        )
    steps = {label(t): 1e3 * t["worst_late_s"] for t in of("step-delay")}
    verdicts.append(_worst("step accepted later than 3 readings and 2.5 mm [ms]", 0.0, steps))
    growth = {f"{label(t)} latency {t['latency_s']:g} s": t["growth"] for t in of("oscillation")}
    verdicts.append(
        _worst("oscillation at latency 0-300 ms, growth of the error", OSCILLATION_GROWTH, growth)
    )
    angle = {f"{t['case']} sensors": t["ratio"] for t in of("normals")}
    verdicts.append(_worst("3+ sensors, normal's angle RMS over the bound", NORMAL_RATIO, angle))
    return verdicts


def evaluate(rows: Sequence[Row], trials: Sequence[Row], conditions: Conditions) -> list[Verdict]:
    """Judge every bar.

    Parameters
    ----------
    rows : rows of the main table and the sweeps, as `Result.row` makes them
    trials : rows of `trials.run_trials`
    conditions : those of the main table
    """
    oracles = _Oracles(rows)
    table = oracles.table
    at_50 = (*TUNABLE, *ORACLES)
    return [
        *_lead_0(oracles),
        *_acceleration(table, "demand acceleration over best oracle", 0.0, ORACLES, 0.6, 1.5),
        *_acceleration(table, "lead 50 mm, demand acceleration over best baseline", LEAD_M, at_50, 1.5, 2.0),
        *_lead_50(table, conditions),
        *_sweeps(table),
        *_trials(trials, conditions),
    ]


def text(verdicts: Sequence[Verdict], markdown: bool = False) -> str:
    """Return the criteria as lines for the terminal, or as a Markdown table."""
    if markdown:
        lines = ["| bar | figure | bound | | |", "| --- | ---: | ---: | --- | --- |"]
        lines += [f"| {v.bar} | {v.figure:.3f} | {_bound(v)} | {_word(v)} | {v.note} |" for v in verdicts]
        return "\n".join(lines) + "\n"
    return "\n".join(f"{_word(v):<6} {v.figure:>9.3f} ≤ {_bound(v):<5} {v.bar} ({v.note})" for v in verdicts)


def near_text(found: Sequence[Row], markdown: bool = False) -> str:
    """Return the cells of `near_the_limit` as lines for the terminal, or as a Markdown table [mm]."""
    heads = ("criterion", "cell", "limit", "reference", "ours", "ours/limit", "")
    rows = [
        (
            r["criterion"],
            r["cell"],
            *(f"{1e3 * r[name]:.3f}" for name in ("limit_m", "reference_m", "ours_m")),
            f"{r['ours_over_limit']:.2f}",
            "exempt" if r["exempt"] else "judged",
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


def _bound(verdict: Verdict) -> str:
    return "–" if verdict.bound == REPORTED else f"{verdict.bound:g}"


def _word(verdict: Verdict) -> str:
    if not verdict.passed:
        return "SHORT"
    return "given" if verdict.bound == REPORTED else "pass"
