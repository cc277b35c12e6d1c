"""Single wrong samples of slow sensors."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from bench_scales import baseline_values, run_baseline, run_follower
from scale_cases import CASES


@pytest.mark.parametrize("seed", [2110, 2116, 2117])
def test_a_wrong_sample_inside_a_wide_gate_does_not_lead_a_slow_sensor_away(seed):
    """GIVEN a winch with 1 Hz WHEN a sample is wrong by less than the gate THEN the next one takes it back.

    All models took its slope, the good samples behind it were outliers, and the tool went on for 3 s:
    1.9 times the error of a P loop with seed 2117, 1.5 times with the others.
    """
    case = next(c for c in CASES["publish"] if c.name.startswith("winch"))
    plain = min(run_baseline(case, kind, values, seed) for kind, values in baseline_values(case)["p"])
    ours = run_follower(case, "ours", seed)
    print(f"RMS {ours:.2f} m, P loop {plain:.2f}")
    assert ours < 1.35 * plain
