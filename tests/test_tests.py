"""Tests share helpers, not each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from two_workers import LONG, WHOLE

TESTS = Path(__file__).parent


def imported_modules(text: str) -> Iterator[str]:
    """Dotted names of the modules that a file imports."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module or ''}.{a.name}" for a in node.names)


def test_no_test_module_imports_another() -> None:
    wrong = [
        f"{path.relative_to(TESTS)} imports {name}"
        for path in sorted(TESTS.rglob("*.py"))
        for name in imported_modules(path.read_text(encoding="utf-8"))
        if any(part.startswith("test_") for part in name.split(".")[:-1] or [name])
    ]
    assert not wrong, "move what they share to a helper module:\n" + "\n".join(wrong)


def test_it_sees_every_way_to_import() -> None:
    assert list(imported_modules("from .test_a import b")) == ["test_a.b"]
    assert list(imported_modules("from service.test_a import b")) == ["service.test_a.b"]
    assert list(imported_modules("def f():\n    import test_a")) == ["test_a"]


def test_the_order_of_the_workers_names_modules_that_exist() -> None:
    assert [name for name in (*LONG, *WHOLE) if not (TESTS.parent / name).exists()] == []
