"""Numbers that would make a plan endless are named before the work."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.errors import ScanInputError
from surffollow.scan import plan as planning


def write_flat(folder: Path) -> str:
    """A level map of 50 x 50 cells in a format without a quantum."""
    header = "ncols 50\nnrows 50\nxllcorner 0\nyllcorner 0\ncellsize 0.02\n"
    (folder / "a.asc").write_text(header + 50 * (50 * "0 " + "\n"))
    return str(folder / "a.asc")


@pytest.mark.parametrize(("words", "why"), [
    (("--lateral-mode", "1e-9"), r"a mode of 1e-09 Hz \(--lateral-mode\) needs a run-up of 5e\+08 m"),
    (("--lateral-mode", "1e-300"), r"\(--lateral-mode\) needs a run-up"),
    (("--body", "disc:1e-9"), r"passes 2e-09 m apart \(--body, whose width is the swath\)"),
    (("--swath", "1e-9"), r"passes 1e-09 m apart \(--swath\)"),
    (("--gap", "1um"), r"5e-07 m apart \(half of --gap\);.* a smaller region, or parts of it"),
])  # fmt: skip
def test_a_plan_that_would_take_for_ever_is_refused_early(tmp_path, monkeypatch, words, why):
    """GIVEN a wrong number WHEN a scan is planned THEN the option is named, and nothing was begun."""
    monkeypatch.setattr(planning, "envelope_of", lambda *_: pytest.fail("the plan was begun"))
    flat = write_flat(tmp_path)
    result = CliRunner().invoke(
        scan_group, ["plan", flat, "-o", str(tmp_path / "a.csv"), "--gap", "5cm", *words]
    )
    assert isinstance(result.exception, ScanInputError), result.output
    assert result.exc_info is not None
    with pytest.raises(ScanInputError, match=why):
        raise result.exception


def test_a_plan_of_many_samples_says_how_long_it_may_take(tmp_path, monkeypatch):
    """GIVEN a small gap WHEN a scan is planned THEN samples and minutes are named before the work."""

    def plan(*_: object) -> None:
        raise ScanInputError("enough")

    monkeypatch.setattr(planning, "plan_scan", plan)
    flat = write_flat(tmp_path)
    words = ["plan", flat, "-o", str(tmp_path / "a.csv")]
    said = [CliRunner().invoke(scan_group, [*words, "--gap", gap]).stderr for gap in ("50um", "5cm")]
    assert said == ["planning about 4.6e+05 samples; this may take 8 min\n", ""]
