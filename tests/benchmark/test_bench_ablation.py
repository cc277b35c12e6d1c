"""The variants of the ablation change source that exists."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import bench_ablation  # noqa: E402


@pytest.mark.parametrize("name", [v for v in bench_ablation.VARIANTS if v != "full"])
def test_every_replaced_line_stands_once_in_its_module(name):
    for module, text, other in bench_ablation.VARIANTS[name]:
        (path,) = (ROOT / "src" / bench_ablation.FORECAST).rglob(f"{module}.py")
        source = path.read_text()
        assert source.count(text) == 1, f"{module}: {text}"
        compile(source.replace(text, other), str(path), "exec")
