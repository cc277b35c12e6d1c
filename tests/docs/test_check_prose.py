"""The check of the prose sees prose, and nothing else."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import check_prose  # noqa: E402


def found(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str = "docs/page.md"
) -> list[str]:
    page = tmp_path / name
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text)
    monkeypatch.setattr(check_prose, "ROOT", tmp_path)
    return list(check_prose.faults(page, show=False))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("The scout sees it.", "look-ahead sensor"),
        ("| a | b |\n| --- | --- |\n| x | the tick |", "controller period"),
        ("What is lost is counted.", "subject"),
        ("# What a loss does\n\nIt ends.", "heading"),
        (" ".join(["word"] * 41) + ".", "a sentence of 41 words"),
        ("Word" + " word" * 20 + ". Word" + " word" * 20 + ".", "21.0 words on average"),
        ("| a |\n| --- |\n| " + "word " * 26 + "|", "a cell of 26 words"),
    ],
)
def test_a_fault_is_found(text: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert any(fault in line for line in found(text, tmp_path, monkeypatch))


@pytest.mark.parametrize(
    "text",
    [
        "The field `scout` is read. `tick` is another.",
        "Run it.\n\n```\nscout " + "word " * 50 + "\n```\n",
        "It is\n\n    tick = the equation\n\nabove.",
        "A [link](scout.md) leads on.",
        "1. " + "word " * 15 + "\n2. " + "word " * 15,
        "<!-- table: written by x -->\n| the tick |\n<!-- end of table -->\n",
        "What is lost?",
    ],
)
def test_code_links_and_generated_parts_are_no_prose(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert found(text, tmp_path, monkeypatch) == []


def test_decisions_keep_their_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert found("The scout won.", tmp_path, monkeypatch, "docs/decisions/1.md") == []


def test_docstrings_that_begin_with_a_question_word_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN modules whose docstrings begin with a question word
    for name in ("src/a.py", "tests/forecast/b.py"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(
            '"""What a client may do."""\n\n\ndef f():\n    """Whatever is left."""\n'
        )
    monkeypatch.setattr(check_prose, "ROOT", tmp_path)
    # THEN all of them are found, with their lines
    assert [line.partition(": ")[0] for line in check_prose.docstring_faults()] == [
        "src/a.py:1",
        "src/a.py:4",
        "tests/forecast/b.py:1",
        "tests/forecast/b.py:4",
    ]
