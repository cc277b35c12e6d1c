"""The default follower is its block diagram: one owner per record, the stages of a cycle in order.

In a cycle owners alone write their records. Resets of the whole follower are all in `reset.py`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from surffollow.forecast.attitude.attitude import limit_attitude
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import Params

FORECAST = Path(__file__).parents[2] / "src" / "surffollow" / "forecast"
STAGES_OF = ("sensing", "estimation", "terrain", "plant", "setpoint", "attitude")
RESETS = FORECAST / "reset.py"
MODULES = [p for stage in STAGES_OF for p in (FORECAST / stage).glob("*.py")]
OWNERS = {
    "clock": "clock",
    "kinematics": "kinematics",
    "hold": "sample_hold",
    "latency": "latency_identification",
    "sample": "measurement",
    "health": "health",
    "frame": "frame_check",
    "run": "constant_ranges",
    "response": "response",
    "descent": "descent",
    "repeats": "repeated_ranges",
    "noise": "noise",
    "pending": "pending_samples",
    "gate": "innovation_gate",
    "bank": "model_bank",
    "earlier": "earlier_bank",
    "shadow": "shadow_axes",
    "weights": "model_weights",
    "lead": "setpoint_lead",
    "estimate": "estimate",
    "controller": "controller_clock",
    "own": "own_setpoints",
    "plant": "plant_identification",
    "blend": "setpoint_blend",
    "setpoint": "setpoint_limits",
    "buffer": "terrain_buffer",
    "lookahead": "lookahead_sensor",
    "preview": "preview",
    "known": "known_ground",
    "plan": "preview_control",
    "beams": "beam_detection",
    "beam_runs": "blocked_beam",
    "plane": "plane_fit",
    "rotation": "rotation_response",
    "attitude": "attitude",
}
STAGES = (
    "update_clock",
    "update_kinematics",
    "update_plant",
    "process_sample",
    "observe_lookahead",
    "update_health",
    "observe_latch",
    "blend_setpoints",
    "plan_period",
    "target_before_limits",
    "permitted_setpoint",
    "limit_setpoint",
    "demand_rotation",
    "record_own_setpoint",
)
WHOLE = "adaptive"


def _names_of(target: ast.expr, value: ast.expr) -> Iterator[tuple[ast.expr, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        yield from zip(target.elts, value.elts)
    else:
        yield target, value


def _aliases(function: ast.FunctionDef) -> dict[str, str]:
    """Local name → record, or record and field of an array: parameters, `g = adaptive.gate`, `z = plan.x`."""
    found = {a.arg: a.arg for a in function.args.args if a.arg in OWNERS}
    for node in sorted((n for n in ast.walk(function) if isinstance(n, ast.Assign)), key=lambda n: n.lineno):
        for target in node.targets:
            for name, value in _names_of(target, node.value):
                if not isinstance(name, ast.Name) or not isinstance(value, ast.Attribute):
                    continue
                parts = ast.unparse(value).split(".")
                if "adaptive" in parts[:-1]:
                    parts = parts[parts.index("adaptive") + 1 :]
                    found[name.id] = parts[0]
                elif parts[0] in found:
                    found[name.id] = found[parts[0]]
    return found


def records_written(source: str) -> Iterator[tuple[int, str]]:
    """(line, record) of every store to a record of the state, aliases and array fields followed."""
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        aliases = _aliases(function)
        for node in ast.walk(function):
            if not isinstance(node, (ast.Attribute, ast.Subscript)) or not isinstance(node.ctx, ast.Store):
                continue
            base: ast.expr = node
            while isinstance(base, ast.Subscript):
                base = base.value
            parts = ast.unparse(base).replace("state[0].", "").split(".")
            if parts[0] == WHOLE and len(parts) > 2:
                yield node.lineno, parts[1]
            elif parts[0] in aliases and (len(parts) > 1 or isinstance(node, ast.Subscript)):
                yield node.lineno, aliases[parts[0]]


def test_every_record_has_an_owner():
    assert {f.name for f in AdaptiveState.FIELDS} == set(OWNERS)
    assert all(f.nested is not None for f in AdaptiveState.FIELDS)
    assert {p.stem for p in MODULES} >= set(OWNERS.values())
    assert len(set(OWNERS.values())) == len(OWNERS)


def test_only_its_owner_writes_a_record():
    wrong, written = [], set()
    for path in sorted(set(FORECAST.rglob("*.py")) - {RESETS}):
        for line, record in records_written(path.read_text(encoding="utf-8")):
            if record not in OWNERS:
                continue
            written.add(record)
            if path not in MODULES or path.stem != OWNERS[record]:
                wrong.append(f"{path.name}:{line} writes {record}")
    assert not wrong, wrong
    assert written == set(OWNERS), "the test sees the writes of every owner"


@pytest.mark.parametrize(
    "line",
    [
        "adaptive.pending.samples = 0",
        "pending = adaptive.pending\n    pending.samples += 1",
        "noise, pending = adaptive.noise, adaptive.pending\n    pending.kept_height_m[0] = 1.0",
        "pending = adaptive.pending\n    kept = pending.kept_height_m\n    kept[0] = 1.0",
        "kept = adaptive.pending.kept_height_m\n    kept[0], other = 1.0, 2.0",
        "noise.sigma_m = adaptive.pending.samples = 0",
    ],
)
def test_the_test_sees_a_write_however_it_is_written(line):
    written = {r for _, r in records_written(f"def f(adaptive, noise):\n    {line}\n")}
    assert "pending" in written
    assert written <= {"pending", "noise"}


def test_a_function_that_gets_one_record_writes_it_under_its_name():
    assert [r for _, r in records_written("def f(plan):\n    plan.setpoint_m = 0.0\n")] == ["plan"]
    attitude = zeros(AdaptiveState)[0]["attitude"]
    attitude["axis"][2] = 1.0
    limit_attitude(zeros(Params)[0], attitude, (0.0, 0.0, 1.0), 1e-3)
    assert attitude["axis"].tolist() == [0.0, 0.0, 1.0]


def test_a_cycle_enters_each_stage_once_in_the_order_of_the_block_diagram():
    tree = ast.parse((FORECAST / "adaptive_step.py").read_text(encoding="utf-8"))
    cycle = next(f for f in tree.body if isinstance(f, ast.FunctionDef) and f.name == "compute_demand")
    calls = [n for n in ast.walk(cycle) if isinstance(n, ast.Call)]
    # a stage's function behind the name of its module
    names = [
        ast.unparse(n.func).rpartition(".")[2] for n in sorted(calls, key=lambda n: (n.lineno, n.col_offset))
    ]
    assert [name for name in names if name in STAGES] == list(STAGES)


def test_modules_are_short_and_no_parameter_is_a_letter_for_the_state():
    for path in FORECAST.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= 300, path.name
        for function in ast.walk(ast.parse(text)):
            if isinstance(function, ast.FunctionDef):
                assert "a" not in [a.arg for a in function.args.args], (path.name, function.name)
