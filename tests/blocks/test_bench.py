"""The short form of tools/bench_blocks.py: no death tears, loses or starves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

TOOLS = Path(__file__).parents[2] / "tools"
TIMES = ("max", "p50")


def test_two_dozen_deaths_tear_lose_and_starve_nothing():
    got = subprocess.run(
        [sys.executable, str(TOOLS / "bench_blocks.py"), "--trials", "24", "--json"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(TOOLS)},
        timeout=400,
    )
    assert got.stdout, got.stderr
    result = json.loads(got.stdout)
    counts = {b["criterion"]: b["got"] for b in result["criteria"] if not b["criterion"].endswith(TIMES)}
    assert set(counts) == {"torn reads", "lost generations", "starved writes", "fenced readers not told"}
    assert set(counts.values()) == {0}
    assert result["waited_for_dead"] + result["died_within_a_slot"] > 0
