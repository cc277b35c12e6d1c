"""Imports go downward only: every import in `src`, lazy ones inside functions included."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src" / "surffollow"

# from top to bottom (ARCHITECTURE.md, "Layers")
LAYERS = (
    ("cli",),
    ("apps", "record", "benchmark"),
    ("service",),
    ("arbiter", "scan", "sonar"),
    ("client", "blocks"),
    ("hw", "sim"),
    ("forecast", "map"),
    ("shm",),
    ("config", "units", "errors", "extras", "release"),
)
LAYER = {package: n for n, packages in enumerate(LAYERS) for package in packages}
# entry points are above every layer
ENTRIES = {"__init__", "__main__"}
# packages of one layer that may import each other, and why
NEIGHBOURS = {
    ("blocks", "client"),  # a block is read through the same latches as a board
    ("hw", "sim"),  # the simulated sensor measures the simulated world
    ("config", "units"),  # quantities in configuration files
    ("config", "errors"),
    ("units", "errors"),
}
# exceptions upward: (importing module, imported package), each with its reason
EXCEPTIONS: dict[tuple[str, str], str] = {
    ("apps.demo", "record"): "the demonstration ends with a replay check of its own recording",
}
# the in-process interface: a package beside the client with kernels behind it
ABOVE = {"follower": LAYER["client"]}


def package_of(path):
    parts = path.relative_to(SRC).with_suffix("").parts
    return parts[0]


def imported_packages(path):
    """(line, package) of every import of ours, at any depth of the file."""
    own = ("surffollow", *path.relative_to(SRC).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(own[: len(own) - node.level + 1]) if node.level else ""
            module = ".".join(p for p in (base, node.module or "") if p)
            names = [module] if module != "surffollow" else [f"surffollow.{a.name}" for a in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # importlib.import_module("surffollow.x"), module names in tables
            names = [node.value] if node.value.startswith("surffollow.") and " " not in node.value else []
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "surffollow" and len(parts) > 1 and parts[1].isidentifier():
                yield node.lineno, parts[1]


def upward_imports():
    wrong = []
    for path in sorted(SRC.rglob("*.py")):
        own = package_of(path)
        if own in ENTRIES:
            continue
        here = ABOVE.get(own, LAYER.get(own))
        module = ".".join(path.relative_to(SRC).with_suffix("").parts)
        for line, package in imported_packages(path):
            there = ABOVE.get(package, LAYER.get(package))
            if package == own or there is None or (own, package) in NEIGHBOURS:
                continue
            if there <= here:
                wrong.append((module, package, f"{path.relative_to(SRC)}:{line} ({own}) imports {package}"))
    return wrong


def test_no_package_imports_from_its_own_layer_or_one_above():
    wrong = [text for module, package, text in upward_imports() if (module, package) not in EXCEPTIONS]
    assert not wrong, "imports that do not go downward:\n" + "\n".join(wrong)


def test_no_exception_outlives_its_need():
    needed = {(module, package) for module, package, _ in upward_imports()}
    assert set(EXCEPTIONS) <= needed, f"drop {set(EXCEPTIONS) - needed}"


def test_every_package_has_a_layer():
    packages = {p.name for p in SRC.iterdir() if (p / "__init__.py").exists()}
    packages |= {p.stem for p in SRC.glob("*.py")} - ENTRIES
    unknown = packages - set(LAYER) - set(ABOVE)
    assert not unknown, f"give {', '.join(sorted(unknown))} a layer in ARCHITECTURE.md and here"


def test_every_package_has_its_init():
    for path in SRC.rglob("*.py"):
        assert (path.parent / "__init__.py").exists(), f"{path.parent} is no package"


@pytest.mark.parametrize(
    ("text", "packages"),
    [
        ("import surffollow.cli.main", {"cli"}),
        ("from surffollow import client", {"client"}),
        ("def f():\n    from surffollow.service.daemon import serve", {"service"}),
        ("from ..record import replay", {"record"}),
        ("import importlib\nimportlib.import_module('surffollow.apps.page')", {"apps"}),
        ("import numpy", set()),
    ],
)
def test_the_test_itself_sees_every_way_to_import(text, packages, tmp_path, monkeypatch):
    folder = tmp_path / "map"
    folder.mkdir()
    file = folder / "x.py"
    file.write_text(text)
    monkeypatch.setattr(f"{__name__}.SRC", tmp_path)
    assert {package for _, package in imported_packages(file)} == packages
