"""Tables of the field demonstration, means over seeds: elements switched off, the paper's figures 6-8."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from surffollow.apps.field import STEEP_AVERAGE_M, Errors, make_field, survey_field
from surffollow.apps.field_calibration import calibrate
from surffollow.apps.field_demo import HUMP_TASK, Progress, shaper_of
from surffollow.apps.field_scan import Run, Task, plan, run
from surffollow.scan.envelope import envelope_of
from surffollow.scan.shaping import Shaper

FILTERS = ("median", "gaussian", "cpf")
FOLLOWINGS = ("none", "reactionary", "atf")
PASS_M = (1.62, -0.4, 1.82, 0.4)  # around one pass over the hump
PASS_TASK = replace(HUMP_TASK, margin_m=0.0, region_m=PASS_M, swath_m=0.3)

Row = tuple[dict[str, Any], Run]


def elements_table(seeds: Sequence[int], progress: Progress | None = None) -> list[dict[str, Any]]:
    """Bumpy ground at 0.5 m/s with each element of the simulation, and each remedy, switched off.

    Returns
    -------
    list of dict     key `switched_off`; `seeds`; mean figures over the seeds, and the worst P99
    """
    return _over(seeds, _elements, progress)


def filters_table(seeds: Sequence[int], progress: Progress | None = None) -> list[dict[str, Any]]:
    """The paper's figures 6-8: filter × ground × correction × shaping, one pass at 0.1 and at 0.5 m/s.

    Returns
    -------
    list of dict     the keys of a case; `seeds`; mean figures over the seeds, and the worst P99
    """
    return _over(seeds, _filters, progress)


def _over(
    seeds: Sequence[int], cases: Callable[[int], Iterator[Row]], progress: Progress | None
) -> list[dict[str, Any]]:
    report = progress if progress is not None else lambda _text, _part: None
    made: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    keys: dict[tuple[Any, ...], dict[str, Any]] = {}
    for k, seed in enumerate(seeds):
        for case, one in cases(seed):
            name = tuple(case.values())
            report(f"seed {seed}: {' '.join(map(str, name))}", k / len(seeds))
            keys[name] = case
            made.setdefault(name, []).append(one.figures())
    return [keys[n] | averaged(rows) for n, rows in made.items()]


def averaged(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean of every figure, the least clearance and the worst P99 of several runs."""
    mean = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
    return mean | {
        "seeds": len(rows),
        "gap_error_p99_worst_m": max(r["gap_error_p99_m"] for r in rows),
        "clearance_min_m": min(r["clearance_min_m"] for r in rows),
    }


def _elements(seed: int) -> Iterator[Row]:
    task = Task()
    names = [f.name for f in fields(Errors)]
    for name in ["nothing", *names]:
        errors = Errors() if name == "nothing" else replace(Errors(), **{name: False})
        place = make_field("bumpy", seed, errors)
        ground, found = survey_field(place), calibrate(place)
        shaper = shaper_of(found)
        desired = plan(ground, task, shaper)
        yield {"switched_off": name}, run(place, desired, found, task)
        if name != "nothing":
            continue
        yield {"switched_off": "both corrections (eqs 8-11)"}, run(place, desired, None, task)
        every = calibrate(place, "triangles")
        yield {"switched_off": "choice by left-out spots"}, run(place, desired, every, task)
        only = replace(found, polar=replace(found.polar, scale=1.0, offset_m=0.0, offset_rad=0.0))
        yield {"switched_off": "polar correction (eqs 8-10)"}, run(place, desired, only, task)
        again = replace(found, surface=envelope_of(ground, task.gap_m))
        yield {"switched_off": "z of the planned place (eq 10)"}, run(place, desired, again, task)
        unshaped = plan(ground, task, Shaper.none())
        yield {"switched_off": "shaping"}, run(place, unshaped, found, task)
        for label, change in (
            ("attitude (reactionary)", {"following": "reactionary"}),
            ("smoothing along the path", {"smooth_m": 0.0}),
            ("body (point detector)", {"following": "none"}),
        ):
            other = replace(task, **change)  # type: ignore[arg-type]
            yield {"switched_off": label}, run(place, plan(ground, other, shaper), found, other)
        for which in ("median", "gaussian"):
            raw = survey_field(place, image_filter=which)
            label = f"CPF ({which} in its place)"
            yield {"switched_off": label}, run(place, plan(raw, task, shaper), found, task)
    exact = make_field("bumpy", seed, Errors(*(False for _ in names)))
    for label, following in (("all errors, map exact", "atf"), ("the same, point detector", "none")):
        other = replace(task, following=following)
        desired = plan(exact.true_grid(), other, Shaper.none())
        yield {"switched_off": label}, run(exact, desired, None, other)


def _filters(seed: int) -> Iterator[Row]:
    for kind in ("flat", "hump"):
        place = make_field(kind, seed)
        found = calibrate(place)
        for which in FILTERS:
            ground = survey_field(place, image_filter=which, average_m=STEEP_AVERAGE_M)
            for speed in (0.1, 0.5):
                for following in FOLLOWINGS:
                    for name, shaper in (("unshaped", Shaper.none()), ("zvd", shaper_of(found))):
                        task = replace(PASS_TASK, speed_mps=speed, following=following)
                        case = {
                            "ground": kind,
                            "filter": which,
                            "speed_mps": speed,
                            "following": following,
                            "shaping": name,
                        }
                        yield case, run(place, plan(ground, task, shaper), found, task)
