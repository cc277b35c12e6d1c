"""No circle of imports among the package's modules, lazy imports included; no module too long to read."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
MAX_LINES = 350


def modules_of(root: Path) -> dict[str, Path]:
    """Dotted name → file."""
    found = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(source: str, modules: Mapping[str, object]) -> set[str]:
    """Modules of ours that a source imports; those for type checkers alone do not count."""
    found: set[str] = set()
    todo: list[ast.AST] = [ast.parse(source)]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            todo += node.orelse
            continue
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for a in node.names:
                full = f"{node.module}.{a.name}"
                found.add(full if full in modules else node.module)
        todo += ast.iter_child_nodes(node)
    return found & set(modules)


def circle_of(graph: Mapping[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as e:
        return list(e.args[1])
    return []


def test_no_modules_import_each_other_in_a_circle():
    modules = modules_of(SRC)
    graph = {name: imports_of(path.read_text(), modules) - {name} for name, path in modules.items()}
    assert circle_of(graph) == []


@pytest.mark.parametrize(
    ("a", "b", "circle"),
    [
        ("import p.b", "from p import a", True),
        ("def f():\n    from p.b import x", "import p.a", True),
        ("import p.b", "import os", False),
        ("if TYPE_CHECKING:\n    import p.b", "import p.a", False),
    ],
)
def test_circles_are_seen(a, b, circle):
    modules = {"p": 0, "p.a": 0, "p.b": 0}
    assert bool(circle_of({"p.a": imports_of(a, modules), "p.b": imports_of(b, modules)})) == circle


def test_no_module_is_longer_than_can_be_read():
    long = {p.name: n for p in SRC.rglob("*.py") if (n := len(p.read_text().splitlines())) > MAX_LINES}
    assert long == {}
