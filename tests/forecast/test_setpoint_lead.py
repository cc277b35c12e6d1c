"""The part of the lead that the setpoints leave out: the regression, and what is learned in closed loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surffollow.benchmark.conditions import Conditions
from surffollow.benchmark.drive import drive
from surffollow.benchmark.followers import follower_config
from surffollow.benchmark.runner import scene_of
from surffollow.benchmark.suite import Cell
from surffollow.follower import Follower
from surffollow.forecast.estimation.model_weights import update_index
from surffollow.forecast.estimation.setpoint_lead import update_lead
from surffollow.forecast.reset import reset_learned
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_estimation import N_MODELS, WAVES

from .feeding import default_params

FLOOR_M = 3e-5


@pytest.mark.parametrize("seed", range(3))
def test_the_part_is_that_of_the_least_mean_square(seed: int) -> None:
    """The twin weighs all errors at once; the kernel updates means over two horizons sample by sample."""
    rng, n, rates = np.random.default_rng(seed), 400, (0.1, 0.02)
    with_lead, without = rng.normal(0.0, 1e-3, (n, WAVES)), rng.normal(0.0, 1e-3, (n, WAVES))
    without += rng.uniform(-1.0, 2.0, WAVES) * with_lead
    target = rng.normal(0.1, 1e-3, n)
    a, params = zeros(AdaptiveState)[0], default_params()
    params["score_floor_m"] = FLOOR_M
    for k in range(n):
        a["shadow"]["position_m"][:WAVES] = target[k] + with_lead[k]
        a["shadow"]["position_m"][N_MODELS:] = target[k] + without[k]
        update_lead(params, a, *rates, target[k])
    effect, parts = with_lead - without, []
    for rate in rates:
        weights = rate * (1.0 - rate) ** np.arange(n - 1, -1, -1)
        parts.append(weights @ (with_lead * effect) / (weights @ effect**2 + FLOOR_M**2))
    least = np.clip(np.minimum(*parts), 0.0, 1.0)
    assert a["lead"]["left_out"][:WAVES] == pytest.approx(least, abs=1e-9)
    assert (a["lead"]["left_out"][WAVES:] == 0.0).all(), "waves keep their lead"
    reset_learned(a)
    assert (a["lead"]["left_out"] == 0.0).all()
    assert (a["lead"]["excess_m2"] == 0.0).all()
    assert (a["lead"]["effect_m2"] == 0.0).all()


def test_a_model_is_scored_with_the_lead_that_it_has() -> None:
    """GIVEN axes that are 1 mm too high with the lead, 1 mm too low without WHEN half is left out."""
    a, params = zeros(AdaptiveState)[0], default_params()
    a["shadow"]["position_m"][:N_MODELS], a["shadow"]["position_m"][N_MODELS:] = 0.101, 0.099
    a["lead"]["left_out"][:WAVES] = 0.5
    update_index(params, a, 1e-3, 0.004, 0.1)
    assert a["weights"]["recent_m2"][:WAVES] == pytest.approx(0.0, abs=1e-12)
    assert (a["weights"]["recent_m2"][WAVES:] > 1e-8).all(), "waves have the whole lead"


def test_a_lead_without_an_effect_is_kept() -> None:
    a, params = zeros(AdaptiveState)[0], default_params()
    a["shadow"]["position_m"] = 0.1005  # both axes have the same error
    for _ in range(1000):
        update_lead(params, a, 0.1, 0.02, 0.1)
    assert (a["lead"]["left_out"] == 0.0).all()


def parts_left_out(surface: str, speed_mps: float) -> Any:
    """Part of the lead that the blend leaves out, over the second half of a run."""
    conditions = Conditions()
    scene = scene_of(Cell(surface, speed_mps, conditions), 1410)
    follower = Follower(config=follower_config(conditions), offset_m=conditions.standoff_m)
    parts: list[float] = []

    class Watched:
        pose = follower.pose

        def step(self, t_ns: int, ranges_m: Any) -> Any:
            demand = follower.step(t_ns, ranges_m)
            a = follower._state["adaptive"][0]
            parts.append(float(a["weights"]["weight"] @ a["lead"]["left_out"]))
            return demand

    run, _ = scene.fresh()
    drive(Watched(), run, _)
    return np.array(parts[len(parts) // 2 :])


def test_ground_that_becomes_predictable_has_its_lead_again_soon() -> None:
    """GIVEN long rough ground WHEN a ramp begins THEN the part is gone after a recent horizon."""
    a, params, rng = zeros(AdaptiveState)[0], default_params(), np.random.default_rng(4)
    recent, longer = 1e-3 / 0.25, 1e-3 / 3.0  # a sample per millimetre
    for _ in range(20_000):
        error = rng.normal(0.0, 2e-3)
        a["shadow"]["position_m"][:WAVES] = 0.1 + error
        a["shadow"]["position_m"][N_MODELS:] = 0.1 + 0.2 * error
        update_lead(params, a, recent, longer, 0.1)
    assert a["lead"]["left_out"][0] == pytest.approx(1.0)
    for _ in range(1000):  # with the lead there is no error, without it 2 mm
        a["shadow"]["position_m"][:WAVES] = 0.1
        a["shadow"]["position_m"][N_MODELS:] = 0.098
        update_lead(params, a, recent, longer, 0.1)
    assert a["lead"]["left_out"][0] < 0.05


@pytest.mark.parametrize(
    ("surface", "speed_mps", "lowest", "highest"),
    [
        ("ramp-5", 0.1, 0.0, 0.15),
        ("sine-400", 0.4, 0.0, 0.1),
        ("bumps", 0.4, 0.5, 1.0),
        ("iso-c", 0.4, 0.5, 1.0),
    ],
)
def test_predictable_ground_keeps_the_lead_and_rough_ground_leaves_it_out(
    surface: str, speed_mps: float, lowest: float, highest: float
) -> None:
    part = float(parts_left_out(surface, speed_mps).mean())
    print(f"{surface} at {1e3 * speed_mps:g} mm/s: {part:.2f}")
    assert lowest <= part <= highest
