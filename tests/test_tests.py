"""Tests share helpers, not each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from two_workers import LONG, WHOLE

TESTS = Path(__file__).parent


def imported_modules(text: str) -> Iterator[str]:
    """Dotted names of the modules that a file imports."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module or ''}.{a.name}" for a in node.names)


def named_test_modules(text: str, modules: set[str]) -> set[str]:
    """Those of `modules` (file names without suffix) that a file imports as a module or imports from."""
    return {part for name in imported_modules(text) for part in name.split(".")} & modules


def test_no_test_module_imports_another() -> None:
    modules = {path.stem for path in TESTS.rglob("test_*.py")}
    wrong = [
        f"{path.relative_to(TESTS)} imports {name}"
        for path in sorted(TESTS.rglob("*.py"))
        for name in sorted(named_test_modules(path.read_text(encoding="utf-8"), modules))
    ]
    assert not wrong, "move what they share to a helper module:\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import test_a", {"test_a"}),
        ("import service.test_a as a", {"test_a"}),
        ("def f():\n    import test_a", {"test_a"}),
        ("from test_a import b", {"test_a"}),
        ("from .test_a import b", {"test_a"}),
        ("from . import test_a", {"test_a"}),
        ("from service import test_a", {"test_a"}),
        ("from ..service.test_a import b", {"test_a"}),
        ("from running_service import test_pose", set()),
    ],
)
def test_every_way_to_import_a_test_module_is_seen(text: str, found: set[str]) -> None:
    assert named_test_modules(text, {"test_a"}) == found


def test_the_order_of_the_workers_names_modules_that_exist() -> None:
    assert [name for name in (*LONG, *WHOLE) if not (TESTS.parent / name).exists()] == []
