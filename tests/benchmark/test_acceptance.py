"""The verdicts follow the rules as written, and the special trials measure what they say."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from surffollow.benchmark import acceptance, comparison, dropouts, near_limit, trials
from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.normals import bound_rad, mounts
from surffollow.benchmark.trials import Job

from .naive_world import make_python_p


def cell(surface: str, speed: float, ours: float, best: float, **more: Any) -> list[dict[str, Any]]:
    head = {
        "surface": surface,
        "speed_mps": speed,
        "lead_m": more.pop("lead_m", 0.0),
        "demand_accel_mps2": 1.0,
    }
    if "variant" in more:
        head["variant"] = more.pop("variant")
    limit = more.pop("limit", 0.0)
    rows = (("ours", ours), ("p:oracle", best), ("kalman-ff:oracle", 1.05 * best), ("limit", limit))
    return [{**head, "method": name, "rms_m": 1e-3 * rms, **more} for name, rms in rows]


def verdict(
    rows: list[dict[str, Any]], start: str, found: list[dict[str, Any]] | None = None
) -> comparison.Verdict:
    return next(
        v for v in acceptance.evaluate(rows, found or [], Conditions()) if v.criterion.startswith(start)
    )


def test_worst_cell_decides_and_is_named() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("bumps", 0.2, 1.2, 1.0) + cell("bumps", 0.4, 1.15, 1.0)
    slow = verdict(rows, "lead 0, RMS over best oracle, up to")
    assert (slow.figure, slow.passed) == (pytest.approx(1.2), False)
    assert "bumps 200 mm/s" in slow.note
    assert verdict(rows, "lead 0, RMS over best oracle, 400").passed


def test_errors_below_a_tenth_of_a_millimetre_are_as_good_as_none() -> None:
    v = verdict(cell("flat", 0.1, 0.09, 0.02), "lead 0, RMS over best oracle, up to")
    assert (v.figure, v.passed) == (1.0, True)


def test_cells_that_physics_decides_are_exempt() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("step", 0.2, 3.0, 1.0, limit=0.81)
    assert verdict(rows, "lead 0, RMS over best oracle, up to").figure == 1.0
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("step", 0.2, 3.0, 1.0, limit=0.79)
    assert verdict(rows, "lead 0, RMS over best oracle, up to").figure == pytest.approx(3.0)


def test_half_of_the_own_error_is_asked_where_the_limit_leaves_a_fifth_of_it() -> None:
    for limit, figure in ((0.39, 0.6), (0.41, math.nan)):
        rows = cell("hump", 0.1, 1.0, 1.0, limit=limit)
        rows += cell("hump", 0.1, 0.6, 1.0, lead_m=0.05, limit=limit)
        found = verdict(rows, "lead 50 mm, RMS over own").figure
        assert found == pytest.approx(figure, nan_ok=True)
        allowed = 1.5 * limit + 0.8 * 0.25
        assert verdict(rows, "lead 50 mm, RMS over 1.5").figure == pytest.approx(0.6 / allowed)


def test_cells_near_the_limit_are_listed_with_what_was_made_of_them() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0, limit=0.3) + cell("step", 0.2, 1.2, 1.0, limit=0.5)
    rows += cell("fy91", 0.4, 0.9, 1.0, limit=0.85) + cell("fy91", 0.4, 0.87, 1.0, limit=0.85, lead_m=0.05)
    found = near_limit.near_the_limit(rows)
    assert [(r["cell"], r["exempt"]) for r in found] == [
        ("step 200 mm/s", False),
        ("fy91 400 mm/s", True),
        ("fy91 400 mm/s", True),
    ]
    assert found[0]["ours_over_limit"] == pytest.approx(2.4)
    assert found[2]["reference_m"] == pytest.approx(0.9e-3)
    assert "2.40" in near_limit.near_text(found)
    assert near_limit.near_text(found, markdown=True).count("\n") == len(found) + 4


def test_families_have_criteria_of_their_own_and_periodic_ones_are_reported_apart() -> None:
    rows = cell("hump", 0.1, 0.8, 1.0) + cell("sine-100", 0.1, 0.2, 1.0)
    rows += cell("weld", 0.2, 1.2, 1.0) + cell("hull", 0.4, 0.9, 1.0) + cell("corrugated", 0.1, 0.1, 1.0)
    assert verdict(rows, "lead 0, geometric mean, all").figure == pytest.approx(math.sqrt(0.8 * 0.2))
    hard = verdict(rows, "families, not periodic, geometric mean")
    assert (hard.figure, hard.passed) == (pytest.approx(math.sqrt(1.2 * 0.9)), False)
    assert verdict(rows, "families, not periodic, RMS over best oracle, up to").figure == pytest.approx(1.2)
    assert verdict(rows, "families, not periodic, RMS over best oracle, 400").passed
    assert verdict(rows, "all periodic").figure == pytest.approx(math.sqrt(0.2 * 0.1))
    reported = verdict(rows, "all surfaces, geometric mean")
    assert reported.passed
    assert reported.figure == pytest.approx((0.8 * 0.2 * 1.2 * 0.9 * 0.1) ** 0.2)
    assert "–" in acceptance.text([reported])


def test_figures_with_fewer_oracles_stand_in_the_note() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0)
    rows.append({**rows[1], "method": "kalman-wave:oracle", "rms_m": 0.5e-3})
    found = verdict(rows, "lead 0, geometric mean, all")
    assert found.figure == pytest.approx(2.0)
    assert "1.000 without kalman-wave; 1.000 with the first four oracles" in found.note


def test_acceleration_at_lead_50_is_compared_with_tuned_and_untuned_baselines() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("hump", 0.1, 0.5, 1.0, lead_m=0.05)
    rows.append({**rows[-3], "method": "kalman-ff", "demand_accel_mps2": 0.25})
    each = verdict(rows, "lead 50 mm, demand acceleration over best baseline, each")
    assert (each.figure, each.passed) == (pytest.approx(4.0), False)
    assert verdict(rows, "demand acceleration over best oracle, each").figure == pytest.approx(1.0)


def test_what_was_not_run_is_short() -> None:
    verdicts = acceptance.evaluate([], [], Conditions())
    assert not any(v.passed for v in verdicts)
    assert "SHORT" in acceptance.text(verdicts)
    assert acceptance.text(verdicts, markdown=True).count("\n") == len(verdicts) + 2


def test_leading_sensor_is_compared_with_own_lead_0_and_the_limit() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("hump", 0.1, 0.6, 1.0, lead_m=0.05)
    assert verdict(rows, "lead 50 mm, RMS over own").figure == pytest.approx(0.6)
    assert verdict(rows, "lead 50 mm, RMS over 1.5").figure == pytest.approx(0.6 / 0.2)
    rows = cell("sine-100", 0.4, 1.0, 1.0) + cell("sine-100", 0.4, 0.9, 1.0, lead_m=0.05)
    assert math.isnan(verdict(rows, "lead 50 mm, RMS over own").figure)


def test_sweeps_are_evaluated_apart_from_the_main_table() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0) + cell("hump", 0.1, 2.0, 1.0, variant="latency=0.3")
    rows += cell("hump", 0.1, 0.8, 1.0, variant="tau×0.7")
    assert verdict(rows, "lead 0, RMS over best oracle, up to").figure == 1.0
    assert verdict(rows, "latency").figure == pytest.approx(2.0 / 1.05)
    assert verdict(rows, "plant τ × 0.7").figure == pytest.approx(0.8)


def test_demand_acceleration_is_compared_with_the_calmest_good_oracle() -> None:
    rows = cell("hump", 0.1, 1.0, 1.0)
    rows[2]["demand_accel_mps2"] = 0.5  # kalman: 1.05 × the best RMS, so it counts
    assert verdict(rows, "demand acceleration over best oracle, each").figure == pytest.approx(2.0)
    rows[2]["rms_m"] = 1.2e-3
    assert verdict(rows, "demand acceleration over best oracle, each").figure == pytest.approx(1.0)


def test_hold_policy_is_worse_on_slopes_and_better_on_crests_and_flats_than_extrapolation() -> None:
    def peak(method: str, case: str) -> float:
        values = [dropouts.dropout_trial(method, case, seed, Conditions())["peak_m"] for seed in (0, 1)]
        return float(np.mean(values))

    assert peak("hold-policy", "slope 0.5 s") > 2.0 * peak("extrapolate-policy", "slope 0.5 s")
    assert peak("hold-policy", "crest 2 s") < peak("extrapolate-policy", "crest 2 s")
    assert peak("hold-policy", "flat 2 s") < peak("extrapolate-policy", "flat 2 s")


def test_p_loop_follows_slots_and_glitches_and_a_held_tool_does_not_move() -> None:
    for case in ("slot", "glitch"):
        moved = {
            method: trials.excursion(Job("excursion", method, 0, Conditions(), "flat", 0.2, case))[
                "excursion_m"
            ]
            for method in ("p", "hold")
        }
        assert moved["hold"] == 0.0
        assert moved["p"] > 2e-3


def test_step_delay_is_zero_for_a_p_loop_and_infinite_for_a_held_tool() -> None:
    assert trials.step_delay(Job("step-delay", "p", 0, Conditions(), "step", 0.2))["late_s"] <= 0.0
    assert trials.step_delay(Job("step-delay", "hold", 0, Conditions(), "step", 0.2))["late_s"] == math.inf


def test_steady_loop_does_not_grow_and_a_gain_too_high_for_the_latency_would_show() -> None:
    figure = trials.oscillation(Job("oscillation", "kalman-ff", 0, Conditions(), "flat", 0.2))
    assert figure["growth"] == pytest.approx(1.0, abs=0.3)


def test_second_pass_sees_the_same_ground_with_other_noise() -> None:
    outside = f"mine={make_python_p.__module__}:make_python_p"
    figures = trials.second_pass(Job("second-pass", outside, 0, Conditions(), "hump", 0.4))
    assert figures["second_m"] == pytest.approx(figures["first_m"], rel=0.2)
    assert figures["second_m"] != figures["first_m"]
    assert figures["limit_m"] < figures["first_m"]


def test_bound_of_the_normal_is_what_least_squares_reaches() -> None:
    rng = np.random.default_rng(4)
    for count in (3, 4, 8):
        xy, sigma = mounts(count), 0.25e-3
        design = np.column_stack([np.ones(count), xy])
        normal = np.array([-0.06, 0.04, 1.0])
        truth = design @ np.array([0.0, 0.06, -0.04])
        angles = []
        for _ in range(4000):
            _, a, b = np.linalg.lstsq(design, truth + sigma * rng.standard_normal(count), rcond=None)[0]
            found = np.array([-a, -b, 1.0])
            cosine = found @ normal / np.linalg.norm(found) / np.linalg.norm(normal)
            angles.append(math.acos(min(1.0, cosine)))
        assert float(np.sqrt(np.mean(np.square(angles)))) == pytest.approx(bound_rad(count, sigma), rel=0.05)


def test_trials_give_one_row_per_case_with_mean_and_worst() -> None:
    rows = trials.run_trials("ours", Conditions(), [], [], 1, None)
    assert rows == []
    jobs = trials.jobs_for("ours", Conditions(), ["hump"], [0, 1])
    assert {j.kind for j in jobs} == set(trials.TRIALS)
    assert {j.method for j in jobs} == {"ours", "hold-policy", "extrapolate-policy"}
