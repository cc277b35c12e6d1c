"""Modules and tests that the pages name exist; decisions record history and are exempt."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from surffollow.cli.old_names import VERBS

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *(p for p in sorted((ROOT / "docs").glob("**/*.md")) if p.parent.name != "decisions"),
]
FOLDERS = ("src", "tests", "tools", "examples", "include")
MODULES = {p.name for folder in FOLDERS for p in (ROOT / folder).rglob("*.*")}
TESTS = {p.stem for p in (ROOT / "tests").rglob("test_*.py")} | {
    name
    for p in (ROOT / "tests").rglob("test_*.py")
    for name in re.findall(r"^(?:async )?def (test_\w+)", p.read_text(encoding="utf-8"), re.MULTILINE)
}


def without_blocks(page: Path) -> str:
    """Text of a page without its code blocks: programs of the reader are named there."""
    text = page.read_text(encoding="utf-8")
    return re.sub(r"^([ ]*)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_a_module_that_a_page_names_exists(page):
    saved = set(
        re.findall(r"as `(\w+\.\w+)`", page.read_text(encoding="utf-8"))
    )  # by the reader of a tutorial
    for name in set(re.findall(r"`(?:[\w.-]+/)*([\w-]+\.(?:py|c|h))\b", without_blocks(page))) - saved:
        assert name in MODULES, name


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_a_page_gives_commands_their_listed_names(page):
    text = page.read_text(encoding="utf-8")
    for old, new in VERBS.items():
        used = re.findall(rf"(?:surffollow |arbiter |blocks |`){old} [^`\n]*", text)
        assert not used, f"{used}; write {new}"


def test_a_module_that_a_docstring_or_comment_names_exists():
    source = ROOT / "src" / "surffollow"
    modules = {".".join(p.relative_to(source).with_suffix("").parts) for p in source.rglob("*.py")}
    packages = {p.parent.name for p in source.glob("*/__init__.py")} - {"client"}  # `client.ee_pos`: a call
    for path in source.rglob("*.py"):
        for package, name in re.findall(r"`(\w+)\.(\w+)`", path.read_text(encoding="utf-8")):
            known = (
                package not in packages
                or f"{package}.{name}" in modules
                or (source / package / name).is_dir()
            )
            assert known, f"{path.relative_to(ROOT)}: {package}.{name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_a_test_that_a_page_names_exists(page):
    for name in set(re.findall(r"\b(test_\w+)", without_blocks(page))):
        assert name in TESTS, name
