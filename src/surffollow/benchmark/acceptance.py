"""The criteria that the default follower must meet, computed from the rows of one run.

A criterion whose figure could not be computed is not met. Criteria without a bound are reported only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from surffollow.benchmark.cell_runs import geometric_mean
from surffollow.benchmark.comparison import (
    FLOOR_M,
    HALF,
    LEAD_M,
    ORACLES,
    OURS,
    REPORTED,
    TUNABLE,
    CellKey,
    Oracles,
    Row,
    Table,
    Verdict,
    cell_name,
    greatest,
    mean_verdict,
    of_family,
    periodic,
    ratios_to_oracles,
    rms_ratio,
    worst_verdict,
)
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.methods import LIMIT, ORACLE
from surffollow.benchmark.near_limit import beyond_half

FAST_MPS = 0.3  # above: the criterion of 400 mm/s
STEP_SCORED_MPS = 0.2
NORMAL_RATIO = 1.2
OSCILLATION_GROWTH = 1.5


def _lead_0(oracles: Oracles) -> list[Verdict]:
    def slow(key: CellKey) -> bool:
        return key[1] < FAST_MPS

    def step(key: CellKey) -> bool:
        return key[0] == "step" and key[1] < STEP_SCORED_MPS

    def smooth(key: CellKey) -> bool:
        return key[0].startswith("sine") or key[0] == "flat"

    others = greatest(oracles.ratios(lambda k: not of_family(k) and slow(k) and not step(k)))
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
    """Demand acceleration over the least of the good methods, and over that of the best, by cell.

    A method of `methods` is good when its RMS is within 1.1 × that of the best of them.
    """
    ratios: dict[CellKey, float] = {}
    over_best: dict[CellKey, float] = {}
    for key in table.where(lead_m):
        ours = table.cells[key].get(OURS)
        rows = [r for name, r in table.cells[key].items() if name in methods]
        if not ours or not rows:
            continue
        best = min(rows, key=lambda r: float(r["rms_m"]))
        good = [r["demand_accel_mps2"] for r in rows if r["rms_m"] <= 1.1 * best["rms_m"]]
        ratios[key] = ours["demand_accel_mps2"] / max(min(good), 1e-9)
        over_best[key] = ours["demand_accel_mps2"] / max(best["demand_accel_mps2"], 1e-9)
    return ratios, over_best


def _acceleration(
    table: Table, start: str, lead_m: float, methods: Sequence[str], mean: float, each: float
) -> list[Verdict]:
    """Demand acceleration over the least among those within 1.1 × the best one's RMS.

    The remarks also give the ratio to the method that is best by RMS, at any acceleration.
    """
    ratios, over_best = _accelerations(table, lead_m, methods)
    worst = max(over_best, key=lambda key: over_best[key], default=None)
    stated_mean = stated_each = ""
    if worst:
        own = [v for k, v in ratios.items() if not of_family(k)]
        stated_mean = (
            f"{len(over_best)} cells; {sum(over_best.values()) / len(over_best):.3f} over the best by RMS"
        )
        stated_mean += f"; {sum(own) / len(own):.3f} without the families" if own else ""
        stated_each = f"{over_best[worst]:.3f} over the best by RMS, {cell_name(worst)}"
    return [
        mean_verdict(f"{start}, mean", mean, list(ratios.values()), stated_mean, geometric=False),
        worst_verdict(f"{start}, each", each, {cell_name(k): v for k, v in ratios.items()}, stated_each),
    ]


def _lead_50(table: Table, conditions: Conditions) -> list[Verdict]:
    own: dict[CellKey, float] = {}
    bound: dict[CellKey, float] = {}
    for key, rows in table.cells.items():
        ours, limit = rows.get(OURS), rows.get(LIMIT)
        at_0 = table.cells.get((key[0], key[1], 0.0, key[3]), {}).get(OURS)
        if key[2] != LEAD_M or key[3] or not ours or not limit or not at_0:
            continue
        if key[0] == "sine-100" and key[1] >= FAST_MPS:
            continue
        small = ours["rms_m"] <= FLOOR_M
        if not beyond_half(limit, at_0):
            own[key] = 0.0 if small else ours["rms_m"] / at_0["rms_m"]
        allowed = 1.5 * limit["rms_m"] + 0.8 * conditions.sensor.sigma_m
        bound[key] = ours["rms_m"] / max(allowed, FLOOR_M)

    def scored(criterion: str, most: float, figures: dict[CellKey, float]) -> Verdict:
        families = {k: v for k, v in figures.items() if of_family(k)}
        worst = max(families, key=lambda k: families[k], default=None)
        note = f"families, without a limit: worst {families[worst]:.3f}, {cell_name(worst)}" if worst else ""
        return worst_verdict(
            criterion, most, {cell_name(k): v for k, v in figures.items() if not of_family(k)}, note
        )

    return [
        scored("lead 50 mm, RMS over own at lead 0", HALF, own),
        scored("lead 50 mm, RMS over 1.5·limit + 0.8·σ", 1.0, bound),
    ]


def _sweeps(table: Table) -> list[Verdict]:
    late: dict[str, float] = {}
    for key in table.where(0.0, lambda v: v.startswith("latency=")):
        ours, kalman = table.cells[key].get(OURS), table.cells[key].get("kalman-ff" + ORACLE)
        if ours and kalman:
            late[cell_name(key)] = rms_ratio(ours["rms_m"], kalman["rms_m"])
    verdicts = [worst_verdict("latency 0-300 ms, RMS over kalman-ff tuned for it", 1.15, late)]
    for factor, bound in ((0.7, 0.90), (1.5, 1.0)):
        ratios = ratios_to_oracles(table, table.where(0.0, lambda v, f=factor: v == f"tau×{f:g}"))  # type: ignore[misc]
        text = f"plant τ × {factor:g} unknown to it, geometric mean over oracles that know"
        verdicts.append(mean_verdict(text, bound, list(ratios.values())))
    return verdicts


def _trials(trials: Sequence[Row], conditions: Conditions) -> list[Verdict]:
    def of(kind: str, method: str = OURS) -> list[Row]:
        return [t for t in trials if t["trial"] == kind and t["method"] == method]

    def label(t: Row) -> str:
        return " ".join(str(v) for v in (t["surface"], f"{1e3 * t['speed_mps']:g} mm/s", t["case"]) if v)

    again: dict[str, float] = {}
    for t in of("second-pass"):
        allowed = max(0.4 * t["first_m"], 1.15 * t["limit_m"], 0.4 * conditions.sensor.sigma_m)
        again[label(t)] = t["second_m"] / allowed
    gain = geometric_mean(t["second_m"] / t["first_m"] for t in of("second-pass"))
    verdicts = [
        worst_verdict("second pass, RMS over its bound", 1.0, again, f"mean {gain:.2f} of first pass")
    ]

    hold = {t["case"]: t["peak_m"] for t in of("dropout", "hold-policy")}
    slide = {t["case"]: t["peak_m"] for t in of("dropout", "extrapolate-policy")}
    ours = {t["case"]: t["peak_m"] for t in of("dropout")}
    worse = {c: rms_ratio(v, max(hold[c], slide[c])) for c, v in ours.items()}
    verdicts.append(worst_verdict("drop-outs, peak over the worse pure policy", 1.0, worse))
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
            worst_verdict(
                f"{case}: demand excursion over σ of the estimate", 1.0, moved, f"{1e3 * most:.3f} mm"
            )
        )
    steps = {label(t): 1e3 * t["worst_late_s"] for t in of("step-delay")}
    verdicts.append(worst_verdict("step accepted later than 3 readings and 2.5 mm [ms]", 0.0, steps))
    growth = {f"{label(t)} latency {t['latency_s']:g} s": t["growth"] for t in of("oscillation")}
    verdicts.append(
        worst_verdict("oscillation at latency 0-300 ms, growth of the error", OSCILLATION_GROWTH, growth)
    )
    angle = {f"{t['case']} sensors": t["ratio"] for t in of("normals")}
    verdicts.append(worst_verdict("3+ sensors, normal's angle RMS over the bound", NORMAL_RATIO, angle))
    return verdicts


def evaluate(rows: Sequence[Row], trials: Sequence[Row], conditions: Conditions) -> list[Verdict]:
    """Evaluate every acceptance criterion.

    Parameters
    ----------
    rows : rows of the main table and the sweeps, as `Result.row` makes them
    trials : rows of `trials.run_trials`
    conditions : those of the main table
    """
    oracles = Oracles(rows)
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
        lines = ["| criterion | figure | bound | | |", "| --- | ---: | ---: | --- | --- |"]
        lines += [
            f"| {v.criterion} | {v.figure:.3f} | {_bound(v)} | {_word(v)} | {v.note} |" for v in verdicts
        ]
        return "\n".join(lines) + "\n"
    return "\n".join(
        f"{_word(v):<6} {v.figure:>9.3f} ≤ {_bound(v):<5} {v.criterion} ({v.note})" for v in verdicts
    )


def _bound(verdict: Verdict) -> str:
    return "–" if verdict.bound == REPORTED else f"{verdict.bound:g}"


def _word(verdict: Verdict) -> str:
    if not verdict.passed:
        return "SHORT"
    return "given" if verdict.bound == REPORTED else "pass"
