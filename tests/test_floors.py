"""Imports go downward only: every import in `src`, lazy ones inside functions included."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src" / "surffollow"

# from the roof to the ground (ARCHITECTURE.md, "Floors")
FLOORS = (
    ("cli",),
    ("live", "record", "benchmark"),
    ("service",),
    ("bridge", "monitor", "arbiter", "scan", "sonar"),
    ("client", "blocks"),
    ("hw", "sim"),
    ("forecast", "map"),
    ("shm",),
    ("config", "units", "errors"),
)
FLOOR = {room: n for n, rooms in enumerate(FLOORS) for room in rooms}
# the package's own front doors are above every floor they lead to
DOORS = {"__init__", "__main__"}
# rooms of one floor that may look at each other, and why
NEIGHBOURS = {
    ("blocks", "client"),  # a block is read through the same latches as a board
    ("hw", "sim"),  # the simulated sensor measures the simulated world
    ("config", "units"),  # quantities in configuration files
    ("config", "errors"),
    ("units", "errors"),
}
# exceptions upward: (importing module, imported room), each with its reason
EXCEPTIONS: dict[tuple[str, str], str] = {
    ("live.demo", "record"): "the demonstration ends with a replay check of its own recording",
}
# the embedders' door: a module at the top of the package with kernels behind it
ABOVE = {"follower": FLOOR["client"]}


def room_of(path):
    parts = path.relative_to(SRC).with_suffix("").parts
    return parts[0]


def imported_rooms(path):
    """(line, room) of every import of ours, at any depth of the file."""
    package = ("surffollow", *path.relative_to(SRC).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
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
        own = room_of(path)
        if own in DOORS:
            continue
        here = ABOVE.get(own, FLOOR.get(own))
        module = ".".join(path.relative_to(SRC).with_suffix("").parts)
        for line, room in imported_rooms(path):
            there = ABOVE.get(room, FLOOR.get(room))
            if room == own or there is None or (own, room) in NEIGHBOURS:
                continue
            if there <= here:
                wrong.append((module, room, f"{path.relative_to(SRC)}:{line} ({own}) imports {room}"))
    return wrong


def test_no_room_imports_from_its_own_floor_or_one_above():
    wrong = [text for module, room, text in upward_imports() if (module, room) not in EXCEPTIONS]
    assert not wrong, "imports that do not go downward:\n" + "\n".join(wrong)


def test_no_exception_outlives_its_need():
    needed = {(module, room) for module, room, _ in upward_imports()}
    assert set(EXCEPTIONS) <= needed, f"drop {set(EXCEPTIONS) - needed}"


def test_every_room_has_a_floor():
    rooms = {p.name for p in SRC.iterdir() if (p / "__init__.py").exists()}
    rooms |= {p.stem for p in SRC.glob("*.py")} - DOORS
    unknown = rooms - set(FLOOR) - set(ABOVE)
    assert not unknown, f"give {', '.join(sorted(unknown))} a floor in ARCHITECTURE.md and here"


def test_every_package_has_its_init():
    for path in SRC.rglob("*.py"):
        assert (path.parent / "__init__.py").exists(), f"{path.parent} is no package"


@pytest.mark.parametrize(
    ("text", "rooms"),
    [
        ("import surffollow.cli.main", {"cli"}),
        ("from surffollow import client", {"client"}),
        ("def f():\n    from surffollow.service.daemon import serve", {"service"}),
        ("from ..record import replay", {"record"}),
        ("import importlib\nimportlib.import_module('surffollow.apps.page')", {"live"}),
        ("import numpy", set()),
    ],
)
def test_the_test_itself_sees_every_way_to_import(text, rooms, tmp_path, monkeypatch):
    package = tmp_path / "map"
    package.mkdir()
    file = package / "x.py"
    file.write_text(text)
    monkeypatch.setattr(f"{__name__}.SRC", tmp_path)
    assert {room for _, room in imported_rooms(file)} == rooms
