"""Notes on CSV logs whose values hardly fit the declared units and signs, and none on right ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surffollow.record.columns import Columns, parse_columns
from surffollow.record.csv_log import CsvLog, read_csv
from surffollow.record.csv_replay import run_csv
from surffollow.record.forecast_scores import summarise

HEADER = "t,d,n,e,u,roll,pitch,yaw\n"


def columns_of(**tables: dict[str, object]) -> Columns:
    names: dict[str, object] = {"roll": "roll", "pitch": "pitch", "yaw": "yaw", "unit": "deg"}
    plain: dict[str, object] = {
        "time": {"column": "t", "unit": "s"},
        "range": {"column": "d", "unit": "m"},
        "position": {"north": "n", "east": "e", "up": "u", "unit": "m"},
        "attitude": names,
    }
    return parse_columns(plain | tables)


def survey(
    folder: Path,
    columns: Columns,
    *,
    time: float = 1.0,
    angle: float = 1.0,
    up: float = 1.0,
    to_s: float = 60.0,
) -> CsvLog:
    """A vehicle on a circle over waves, which bobs, pitches and rolls; written times factors."""
    t = np.arange(0.0, to_s, 0.1)
    turn = 0.2 * t
    north, east = 20.0 * np.sin(turn), -20.0 * np.cos(turn)
    z = 10.0 + np.sin(1.3 * t)
    ground = 0.1 * np.sin(0.3 * north) * np.cos(0.2 * east)
    roll, pitch = 8.0 * np.sin(0.9 * t), 4.0 * np.cos(1.1 * t)
    yaw = np.degrees(turn)
    cells = (time * t, z - ground, north, east, up * z, angle * roll, angle * pitch, angle * yaw)
    (folder / "log.csv").write_text(
        HEADER + "\n".join(",".join(f"{v:.9f}" for v in row) for row in zip(*cells))
    )
    return read_csv(folder / "log.csv", columns)


DEPTH: dict[str, object] = {"column": "d", "unit": "m", "kind": "depth"}
IN_RAD: dict[str, object] = {"roll": "roll", "pitch": "pitch", "yaw": "yaw", "unit": "rad"}
DOWN: dict[str, object] = {"north": "n", "east": "e", "down": "u", "unit": "m"}


def test_a_right_log_has_no_note(tmp_path: Path) -> None:
    for tables in ({}, {"range": DEPTH}):
        assert survey(tmp_path, columns_of(**tables)).notes == ()
    assert survey(tmp_path, columns_of(attitude=IN_RAD), angle=np.pi / 180.0).notes == ()
    assert survey(tmp_path, columns_of(position=DOWN), up=-1.0).notes == ()
    assert survey(tmp_path, columns_of(time={"column": "t", "unit": "ms"}), time=1e3).notes == ()


def test_a_level_vehicle_that_keeps_its_course_has_no_note(tmp_path: Path) -> None:
    """Angles of hundredths of a degree are right ones of a gantry."""
    rows = [f"{0.1 * k:.1f},0.1,{0.01 * k:.2f},0,0.2,0.01,-0.02,0.03" for k in range(500)]
    (tmp_path / "log.csv").write_text(HEADER + "\n".join(rows))
    assert read_csv(tmp_path / "log.csv", columns_of()).notes == ()


@pytest.mark.parametrize(
    ("unit", "factor", "note"),
    [
        ("us", 1.0, 'the rows are 1e-07 s apart by [time] unit = "us"; in s they would be 0.1 s apart'),
        ("ms", 0.1, 'the rows are 1e-05 s apart by [time] unit = "ms"; in s they would be 0.01 s apart'),
        (
            "ms",
            3.0,
            'the vehicle moves at 1.32e+03 m/s by [time] unit = "ms" and [position] unit = "m"; check both',
        ),
    ],
)
def test_times_in_a_shorter_unit_are_noted(tmp_path: Path, unit: str, factor: float, note: str) -> None:
    assert survey(tmp_path, columns_of(time={"column": "t", "unit": unit}), time=factor).notes == (note,)


def test_times_in_a_longer_unit_are_noted_with_the_other_one(tmp_path: Path) -> None:
    columns = columns_of()
    log = survey(tmp_path, columns, time=1e3)
    (note,) = [n for n in summarise("log.csv", run_csv(log, columns), columns)["notes"] if "compared" in n]
    assert "100 s apart; in ms they would be 0.1 s apart)" in note
    assert 'check [time] unit = "s"' in note


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us")])
def test_a_clock_of_another_unit_is_noted(tmp_path: Path, factor: float, unit: str) -> None:
    rows = [f"{(1.75e9 + 0.001 * k) * factor:.0f},1,0,0,0,0,0,0" for k in range(9)]
    (tmp_path / "log.csv").write_text(HEADER + "\n".join(rows))
    (note,) = read_csv(tmp_path / "log.csv", columns_of()).notes
    assert f'by [time] unit = "s" are dates of this century in {unit}' in note


def test_angles_in_the_other_unit_are_noted(tmp_path: Path) -> None:
    (note,) = survey(tmp_path, columns_of(), angle=np.pi / 180.0).notes
    assert note.endswith("and the course over ground turns as yaw does in rad; try rad")
    (note,) = survey(tmp_path, columns_of(attitude=IN_RAD)).notes
    assert note.startswith("roll or pitch is beyond a full turn in ")
    assert note.endswith('rows by [attitude] unit = "rad"; try deg')


@pytest.mark.parametrize(
    ("tables", "up", "note"),
    [({"position": DOWN}, 1.0, 'try up = "u"'), ({}, -1.0, 'try down = "u"')],
)
@pytest.mark.parametrize("kind", ["range", "depth"])
def test_a_height_of_the_other_sign_is_noted(
    tmp_path: Path, kind: str, tables: dict[str, dict[str, object]], up: float, note: str
) -> None:
    (found,) = survey(tmp_path, columns_of(range=DEPTH | {"kind": kind}, **tables), up=up).notes
    assert "the sign of the height seems wrong" in found
    assert found.endswith(note)


@pytest.mark.parametrize(
    ("names", "scale", "noted"),
    [
        (("lat", "lon"), 1e-4, True),
        (("GPS_Lat", "GPS_Lng"), 1e-4, True),
        (("lat", "lon"), 100.0, False),
        (("n", "e"), 1e-4, False),
    ],
)
def test_degrees_that_count_as_metres_are_noted(
    tmp_path: Path, names: tuple[str, str], scale: float, noted: bool
) -> None:
    """A drone's log became a map of 2 m by 2 m."""
    north, east = names
    rows = [f"{k / 10},5.0,{47.0 + scale * k},{8.0 + scale * k}" for k in range(60)]
    (tmp_path / "log.csv").write_text("\n".join([f"t,d,{north},{east}", *rows]))
    place = {"north": north, "east": east, "unit": "m"}
    time, distance = {"column": "t", "unit": "s"}, {"column": "d", "unit": "m"}
    columns = parse_columns({"time": time, "range": distance, "position": place})
    notes = read_csv(tmp_path / "log.csv", columns).notes
    text = f'[position] north = "{north}" and east = "{east}" look like degrees, and count as m: convert'
    assert any(note.startswith(text) for note in notes) == noted
