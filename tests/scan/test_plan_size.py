"""Numbers that would make a plan endless are named before the work."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.errors import ScanInputError
from surffollow.map import HeightMap
from surffollow.scan import plan as planning


@pytest.mark.parametrize(("words", "why"), [
    (("--lateral-mode", "1e-9"), r"a mode of 1e-09 Hz \(--lateral-mode\) needs a run-up of 5e\+08 m"),
    (("--lateral-mode", "1e-300"), r"\(--lateral-mode\) needs a run-up"),
    (("--body", "disc:1e-9"), r"passes 2e-09 m apart \(--body, whose width is the swath\)"),
    (("--swath", "1e-9"), r"passes 1e-09 m apart \(--swath\)"),
])  # fmt: skip
def test_a_plan_that_would_take_for_ever_is_refused_early(tmp_path, monkeypatch, words, why):
    """GIVEN a wrong number WHEN a scan is planned THEN the option is named, and nothing was begun."""
    monkeypatch.setattr(planning, "envelope_of", lambda *_: pytest.fail("the plan was begun"))
    HeightMap.from_heights(np.zeros((50, 50)), origin_m=(0.0, 0.0), grid_m=0.02).save(tmp_path / "a.npz")
    result = CliRunner().invoke(
        scan_group, ["plan", str(tmp_path / "a.npz"), "-o", str(tmp_path / "a.csv"), "--gap", "5cm", *words]
    )
    assert isinstance(result.exception, ScanInputError), result.output
    assert result.exc_info is not None
    with pytest.raises(ScanInputError, match=why):
        raise result.exception
