"""The cycle of the paper mode beside its twin in plain C."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
from bench_cycle import SKIP, measure


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_cycle_has_the_bits_of_its_twin_in_c():
    """The counter of readings outside the window had been added to one of them only."""
    assert measure(SKIP + 2, 200)["differences"] == []
