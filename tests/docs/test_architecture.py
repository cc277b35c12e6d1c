"""ARCHITECTURE.md is short and names files that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
PATHS = sorted(set(re.findall(r"`((?:[\w.-]+/)+[\w.-]*)`", TEXT)) | set(re.findall(r"\]\(([^)#:]+)", TEXT)))


def test_it_is_short_and_names_many_files():
    assert TEXT.count("\n") <= 120
    assert len(PATHS) > 50


@pytest.mark.parametrize("path", PATHS)
def test_every_path_exists(path):
    assert (ROOT / path).exists() or (ROOT / "src" / "surffollow" / path).exists()


def test_every_package_stands_in_the_layers():
    layers = TEXT.partition("## Layers")[2].partition("```")[2].partition("```")[0]
    named = set(re.findall(r"^((?:\w+ {1,2})+) ", layers, re.M))
    words = {word for line in named for word in line.split()}
    packages = {p.parent.name for p in (ROOT / "src" / "surffollow").glob("*/__init__.py")} - {"follower"}
    assert packages <= words, packages - words
