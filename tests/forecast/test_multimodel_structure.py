"""The multiple-model follower is its block diagram: one owner per record, one way through the stages."""

import ast
from pathlib import Path

import numpy as np
import pytest

from surffollow.forecast.estimation.models import LEVEL, SLOPE, WAVE, predict_model, setpoint_of, update_model
from surffollow.forecast.plant.axis import axis_step, axis_velocity, distance_for
from surffollow.forecast.tuning import DEFAULTS, MODELS, new_multimodel
from surffollow.shm.layout_multimodel import MultimodelState, Tuning
from surffollow.sim import plant as sim_plant

FORECAST = Path(__file__).parents[2] / "src" / "surffollow" / "forecast"
OWNERS = {
    "reference": "scales.py",
    "kinematics": "sensing/kinematics.py",
    "sample": "sensing/sample.py",
    "health": "sensing/health.py",
    "noise": "estimation/noise.py",
    "gate": "estimation/innovation_gate.py",
    "bank": "estimation/model_bank.py",
    "weights": "estimation/model_weights.py",
    "shadow": "plant/shadow_axes.py",
    "plant": "plant/identification.py",
    "setpoint": "setpoint/",
    "buffer": "terrain/buffer.py",
    "tuning": "none",
}
STAGES = (
    "observe_motion",
    "take_sample",
    "watch_readings",
    "watch_ranges",
    "identify",
    "estimate",
    "store_height",
    "is_lost",
    "assess",
    "blend_setpoints",
    "filter_setpoint",
    "limit_setpoint",
    "record_setpoints",
)


def records_written(path):
    """(line, record) of every assignment to a record of `m`, aliases like `g = m.gate` followed."""
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(function, ast.FunctionDef):
            continue
        aliases = {}
        for node in ast.walk(function):
            if not isinstance(node, ast.Assign):
                continue
            names, values = node.targets[0], node.value
            pairs = (
                zip(names.elts, values.elts)
                if isinstance(values, ast.Tuple) and isinstance(names, ast.Tuple)
                else [(names, values)]
            )
            for name, value in pairs:
                if (
                    isinstance(name, ast.Name)
                    and ast.unparse(value).startswith("m.")
                    and isinstance(value, ast.Attribute)
                    and ast.unparse(value).count(".") == 1
                ):
                    aliases[name.id] = value.attr
        for node in ast.walk(function):
            if isinstance(node, (ast.Attribute, ast.Subscript)) and isinstance(node.ctx, ast.Store):
                parts = ast.unparse(node).split("[")[0].split(".")
                if parts[0] == "m" and len(parts) > 2:
                    yield node.lineno, parts[1]
                elif parts[0] in aliases and len(parts) > 1:
                    yield node.lineno, aliases[parts[0]]


def test_only_its_owner_writes_a_record():
    wrong, written = [], set()
    for path in sorted(FORECAST.rglob("*.py")):
        module = path.relative_to(FORECAST).as_posix()
        if "/" not in module and module not in ("multimodel.py", "scales.py"):
            continue
        for line, record in records_written(path):
            written.add(record)
            if record in OWNERS and not module.startswith(OWNERS[record]):
                wrong.append(f"{module}:{line} writes {record}")
    assert not wrong, wrong
    assert {"gate", "bank", "sample", "shadow", "weights"} <= written, "the test sees no writes"


def test_every_record_has_an_owner():
    assert {f.name for f in MultimodelState.FIELDS} == set(OWNERS)


def test_a_cycle_enters_each_stage_once_in_order_and_returns_at_its_end():
    tree = ast.parse((FORECAST / "multimodel.py").read_text(encoding="utf-8"))
    cycle = next(f for f in tree.body if isinstance(f, ast.FunctionDef) and f.name == "demand_of")
    calls = [n for n in ast.walk(cycle) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    names = [ast.unparse(n.func) for n in sorted(calls, key=lambda n: (n.lineno, n.col_offset))]
    order = [name for name in names if name in STAGES]
    assert order == list(STAGES)
    returns = [n for n in ast.walk(cycle) if isinstance(n, ast.Return)]
    assert len(returns) == 1
    assert returns[0] is cycle.body[-1]


def test_every_constant_of_the_table_has_a_default_and_a_meaning():
    fields = {f.name: f for f in Tuning.FIELDS}
    assert set(DEFAULTS) | {"models", "n_models"} == set(fields)
    assert all(f.doc and not f.unit for f in fields.values())


@pytest.mark.parametrize("kind", [LEVEL, SLOPE, WAVE])
@pytest.mark.parametrize("seed", range(3))
def test_a_model_is_the_textbook_filter(kind, seed):
    """Twin: the same Kalman filter in matrices."""
    rng = np.random.default_rng([seed, kind])
    state = new_multimodel({"models": [(kind, 5.0, 1.5 if seed == 1 else 0.0)]})
    u = state["tuning"][0]
    spacing, reaction, omega = 0.01, 0.2, 7.0
    x, p = np.zeros(3), np.zeros(6)
    mean, cov = np.zeros(3), np.diag([1.0, 0.5 if kind != LEVEL else 0.0, 0.5 if kind == WAVE else 0.0])
    p[[0, 3, 5]] = np.diag(cov)
    see = np.array([1.0, 1.0 if kind == WAVE else 0.0, 0.0])
    for _ in range(60):
        d, h = spacing * rng.uniform(0.5, 2.0), rng.standard_normal()
        move, noise, gain = np.eye(3), np.zeros((3, 3)), 1.0 / 5.0
        if kind == LEVEL:
            noise[0, 0] = gain**2 / (1 - gain) * d / spacing
        elif kind == SLOPE:
            a = 1.5 * reaction
            e, g = (np.exp(-d / a), a * (1 - np.exp(-d / a))) if seed == 1 else (1.0, d)
            move[0, 1], move[1, 1] = g, e
            q = (0.5 * gain**2) ** 2 / spacing**3
            noise[:2, :2] = q * np.array([[d**3 / 3, d**2 / 2], [d**2 / 2, d]])
        else:
            c, s = np.cos(omega * d), np.sin(omega * d)
            move[1:, 1:] = [[c, s], [-s, c]]
            q = 2.0 * gain**2 * d / spacing
            noise = np.diag([u["wave_mean_drift"] ** 2 * q, q, q])
        mean, cov = move @ mean, move @ cov @ move.T + noise
        k = cov @ see / (see @ cov @ see + 1.0)
        mean, cov = mean + k * (h - see @ mean), cov - np.outer(k, see @ cov)
        predict_model(u, 0, x, p, d, spacing, reaction, omega)
        update_model(u, 0, x, p, h, 1e9, 0)
        np.testing.assert_allclose(
            x[: 2 if kind == SLOPE else 3], mean[: 2 if kind == SLOPE else 3], atol=1e-9
        )
        np.testing.assert_allclose(p[[0, 1, 3]], [cov[0, 0], cov[0, 1], cov[1, 1]], atol=1e-9)
    ahead = setpoint_of(u, 0, x, 0.03, 0.0, reaction, spacing, omega)
    if kind == SLOPE and seed != 1:
        assert ahead == pytest.approx(mean[0] + 0.03 * mean[1])


def test_the_axis_model_is_the_simulated_axis():
    rng = np.random.default_rng(3)
    z, v, axis = 0.0, 0.0, np.zeros(2)
    for _ in range(400):
        target = 0.02 * rng.standard_normal()
        for _ in range(5):
            z, v = axis_step(z, v, target, 0.04, 0.2, 2.0, 1e-3)
            sim_plant.axis_step(axis, target, 0.04, 0.2, 2.0, 1e-3)
        assert z == pytest.approx(axis[0], abs=1e-12)


@pytest.mark.parametrize("velocity", [0.01, 0.079, 0.081, 0.15, -0.03, -0.15])
def test_the_distance_of_a_velocity_is_the_inverse_of_the_axis(velocity):
    assert axis_velocity(distance_for(velocity, 0.04, 2.0), 0.04, 1.0, 2.0) == pytest.approx(velocity)


def test_the_table_of_models_is_what_the_state_holds():
    tuning = new_multimodel()["tuning"][0]
    assert tuning["n_models"] == len(MODELS)
    np.testing.assert_array_equal(tuning["models"][: 3 * len(MODELS)].reshape(-1, 3), MODELS)


def test_an_innovation_turns_the_slope_by_no_more_than_its_bound():
    u = new_multimodel({"models": [(SLOPE, 4.0, 0.0)]})["tuning"][0]
    found = []
    for innovation in (0.5, 1.0, 40.0):
        x, p = np.zeros(3), np.array([1.0, 20.0, 0.0, 900.0, 0.0, 0.0])
        update_model(u, 0, x, p, innovation, 1.0, 0)
        found.append(x.copy())
    assert found[0][1] == pytest.approx(0.5 * found[1][1])
    assert found[2][1] == found[1][1]
    assert found[2][0] == pytest.approx(40.0 * found[1][0])
