"""In a source tree that is not installed (PYTHONPATH alone) commands work; the version is unknown."""

from __future__ import annotations

import importlib.metadata
import json

import pytest

import surffollow
from surffollow.cli.main import main
from surffollow.shm.layout_json import identity


@pytest.fixture(autouse=True)
def not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No package of the name surffollow is found."""

    def fail(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata.Distribution, "from_name", fail)


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the output of a command that ends well."""
    with pytest.raises(SystemExit) as end:
        main(list(words))
    out, err = capsys.readouterr()
    assert (end.value.code, err) == (0, "")
    return out


def test_the_version_is_unknown(capsys: pytest.CaptureFixture[str]) -> None:
    assert printed(capsys, "--version") == "surffollow, version unknown\n"
    assert surffollow.__version__ == "unknown"


def test_the_layout_of_a_status_has_a_release() -> None:
    assert identity()["release"] == "unknown"


def test_the_header_and_the_layout_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "Version: unknown\n" in printed(capsys, "print-header", "--pkg-config")
    assert json.loads(printed(capsys, "print-header", "--json"))["release"] == "unknown"
