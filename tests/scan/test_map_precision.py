"""Heights of a map are fine enough for the gap, or the commands say so."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.errors import ScanInputError
from surffollow.map import HeightMap
from surffollow.map.files import export
from surffollow.scan.map_file import read_ground, step_note

Y, X = np.mgrid[:60, :60] * 0.02
GROUND = 0.05 * np.sin(4.0 * X) * np.cos(3.0 * Y)


def run(*arguments):
    return CliRunner().invoke(scan_group, [str(a) for a in arguments])


def plan(ground, path):
    region = ("--region", "0.4,0.4,0.8,0.8", "--body", "disc:0.05")
    return run("plan", ground, "-o", path, "--gap", "5cm", *region)


def save(folder, quantum_m):
    m = HeightMap.from_heights(GROUND, origin_m=(0.0, 0.0), grid_m=0.02, quantum_m=quantum_m)
    m.save(folder / "ground.npz")
    return folder / "ground.npz"


@pytest.mark.parametrize(("quantum_m", "warned", "refused"), [
    (0.9e-3, False, False), (2e-3, True, False), (9e-3, True, False), (12e-3, False, True),
])  # fmt: skip
def test_plan_check_and_run_look_at_the_step_of_the_heights(tmp_path, quantum_m, warned, refused):
    """GIVEN heights in coarse steps WHEN a scan with a gap of 5 cm is planned THEN half a step is named."""
    fine = save(tmp_path, 1e-4)
    assert plan(fine, tmp_path / "path.csv").exit_code == 0
    coarse = save(tmp_path, quantum_m)
    results = [
        plan(coarse, tmp_path / "other.csv"),
        run("check", coarse, tmp_path / "path.csv"),
        run("run", tmp_path / "path.csv", "--map", coarse),
    ]
    for result in results:
        assert (isinstance(result.exception, ScanInputError) and "half a step" in str(result.exception)) == (
            refused
        )
        assert ("warning: " in result.output and "half a step" in result.output) == warned
    assert (results[0].exit_code == 0) == (not refused)


def test_a_raster_needs_no_step(tmp_path):
    """GIVEN a slope with 2000 m of relief WHEN it is read from a raster THEN its heights are not rounded."""
    steep = GROUND + 1700.0 * X
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in steep[::-1])
    (tmp_path / "dem.asc").write_text(
        f"ncols 60\nnrows 60\nxllcorner 0\nyllcorner 0\ncellsize 0.02\nNODATA_value -9999\n{rows}\n"
    )
    ground, m = read_ground(tmp_path / "dem.asc")
    assert m is None
    np.testing.assert_array_equal(ground.heights_m, steep)
    result = run("plan", tmp_path / "dem.asc", "-o", tmp_path / "path.csv", "--gap", "5cm", "--body", "point",
                 "--swath", "0.2", "--region", "0.4,0.4,0.8,0.8")  # fmt: skip
    assert "half a step" not in result.output
    # what the service would hold of it is in steps of 31 mm
    stored = HeightMap.load(tmp_path / "dem.asc")
    export(tmp_path / "dem.npz", stored.header, stored.pairs)
    refused = run("check", tmp_path / "dem.npz", tmp_path / "path.csv")
    assert "in steps of" in str(refused.exception)


def test_what_is_small_beside_the_gap_needs_no_note():
    assert step_note(0.0, 0.05, "a map") == ""
    assert step_note(25.4e-6, 0.005, "a map") == ""
    assert "half a step is 2 % of the gap of 0.05 m" in step_note(2e-3, 0.05, "a map")
    with pytest.raises(ScanInputError, match=r"a map has heights in steps of 2e\+03 mm"):
        step_note(2.0, 0.05, "a map")
