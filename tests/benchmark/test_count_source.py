"""The count of lines and constants is that of somebody who reads the source."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import count_source

SOURCE = '''"""Module,
with a docstring."""

import math  # counts

A_M, B = 1.0, 2  # two constants
_C: int = 3
"""Their text does not count."""
lower = 4


def f(x):
    """Nothing.

    More of it.
    """
    # a comment
    return (
        x + math.pi
    )
'''


def test_lines_without_comments_docstrings_and_blanks_count():
    assert count_source.count_lines(SOURCE) == 8
    assert count_source.constants(SOURCE) == {"A_M", "B", "_C"}


def test_numbers_in_functions_count_but_for_structure_and_units():
    assert count_source.unnamed_numbers(SOURCE) == 0
    assert count_source.unnamed_numbers("A = 5\ndef f(x):\n    return 0.3 * x + 2 * 1e-9 * x[7] - 4.0\n") == 2


def test_the_follower_is_counted_by_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert count_source.main(["--json"]) == 0
    stages = json.loads(capsys.readouterr().out)
    assert {"sensing", "estimation", "terrain", "plant", "setpoint", "attitude", "paper"} < set(stages)
    assert stages["all"]["lines"] == sum(row["lines"] for name, row in stages.items() if name != "all")
    assert count_source.main([]) == 0
    assert "estimation" in capsys.readouterr().out
