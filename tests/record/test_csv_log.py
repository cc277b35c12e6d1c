"""CSV logs by a column file: units, frames, values that are no reading, and refusals with their place."""

from __future__ import annotations

import math
import os
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from csv_logs import EXAMPLES, HEADER, PLAIN, log_of, plain
from surffollow.errors import InputFileError, UsageError
from surffollow.record.columns import load_columns, parse_columns
from surffollow.record.csv_cells import ROWS_PER_REPORT
from surffollow.record.csv_log import read_csv
from surffollow.record.csv_replay import target_points

DEPTH: dict[str, object] = {"column": "d", "unit": "cm", "min": "5 cm", "max": "10 m", "kind": "depth"}


def test_units_and_frames_become_metres_and_a_pose_looking_down(tmp_path: Path) -> None:
    log = log_of(tmp_path, HEADER + "1500,200,1000,2000,3000,0,0,0\n")
    assert log.t_s.tolist() == [1.5]
    assert log.range_m.tolist() == [2.0]
    np.testing.assert_allclose(log.pose[0, :3], [2.0, 1.0, 3.0])
    np.testing.assert_allclose(target_points(log, plain())[0], [2.0, 1.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ("90,0,0", (0.0, -2.0, 0.0)),  # right side down, heading north: the belly shows west
        ("0,90,0", (2.0, 0.0, 0.0)),  # nose up, heading north: the belly shows north
        ("0,90,90", (0.0, 2.0, 0.0)),  # nose up, heading east: the belly shows east
        ("20,30,77", None),
    ],
)
def test_attitude_turns_the_beam_as_on_a_vehicle(
    tmp_path: Path, angles: str, expected: tuple[float, ...] | None
) -> None:
    log = log_of(tmp_path, HEADER + f"0,200,0,0,0,{angles}\n")
    east, north, up = target_points(log, plain())[0]
    if expected is not None:
        np.testing.assert_allclose((north, east, up), expected, atol=1e-12)
    else:
        roll, pitch = (math.radians(float(a)) for a in angles.split(",")[:2])
        assert up == pytest.approx(-2.0 * math.cos(roll) * math.cos(pitch))


def test_values_that_mean_no_reading_or_lie_outside_the_limits_are_none(tmp_path: Path) -> None:
    rows = "".join(
        f"{i},{d},0,0,0,0,0,0\n" for i, d in enumerate(["0", "999", "4.9", "1001", "", "nan", "5"])
    )
    log = log_of(tmp_path, HEADER + rows)
    assert np.isfinite(log.range_m).tolist() == [False] * 6 + [True]


def test_spaces_blank_lines_quotes_and_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    log = log_of(tmp_path, "\ufeff" + '"t", d ,n,e,u,roll,pitch,yaw,more\n\n 1 ,"20", 0,0,0,0,0,0,x\n\n')
    assert log.range_m.tolist() == [0.2]


@pytest.mark.parametrize("sign", [",", "."])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_semicolons_and_tabs_are_read_with_either_decimal_sign(
    tmp_path: Path, separator: str, sign: str
) -> None:
    rows = HEADER.replace(",", separator) + separator.join(["1500*5", "200*25", *"000000"]) + "\n"
    log = log_of(tmp_path, rows.replace("*", sign))
    assert log.t_s.tolist() == [1.5005]
    assert log.range_m.tolist() == [2.0025]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,d,n,e,u,roll,pitch\n", r"log\.csv has no column 'yaw'; it has t, d, n, e, u, roll, pitch"),
        ("t,\x1b[31mred\x07\n", r"log\.csv has no column 'd'; it has t, \\x1b\[31mred\\x07; change"),
        ("", r"log\.csv is empty; expected a line of column names"),
        (HEADER.replace(",", ";") + "1,5;2.5;0;0;0;0;0;0\n", "line 2, column 'd': '2.5': .*one decimal sign"),
        (HEADER.replace(",", ";") + "1;1,234,5;0;0;0;0;0;0\n", "'1.234.5' is not a finite number"),
        (HEADER, r"log .*log\.csv has a line of column names and no row"),
        ("logger 7\n2026\n" + HEADER, "column names are in line 3; remove the lines above"),
        ("\0" * 100_000, r"log\.csv has zero bytes from line 1 on: a crash cut or padded it"),
        (HEADER + "1,2,0,0,0,0,0,0\n2,2,0\0\0\0", r"log\.csv has zero bytes from line 3 on: .*remove them"),
        ("n" * 100_000, r"it has n{200}…; change the column file"),
        (HEADER + "1," + "x" * 100_000 + ",0,0,0,0,0,0\n", r"line 2, column 'd': 'x{200}…' is not"),
        (HEADER + "1,2,0,0,0,0,0,0\n2,x,0,0,0,0,0,0\n", r"log\.csv, line 3, column 'd': 'x' is not"),
        (HEADER + "1,2,0,0,0,0\n", r"log\.csv: column 'pitch' has no value in any row; name another"),
        (HEADER + "1,2,0,0,0,0,0,0\n2,2,0,0,0,0,0,0,7,8\n", r"log\.csv, line 3: 10 values for 8 columns"),
        (HEADER.replace("roll", "d"), r"log\.csv has no column 'roll'"),
        ("d," + HEADER, r"log\.csv: column 'd' occurs more than once; rename the others"),
        (HEADER + "1,2,inf,0,0,0,0,0\n", r"line 2, column 'n': 'inf' is not"),
        (HEADER + "nan,2,0,0,0,0,0,0\n", r"line 2, column 't': 'nan' is not"),
        (
            HEADER + "2026-11-30T20:00:00Z,2,0,0,0,0,0,0\n",
            r"column 't': '2026-.*; give \[time\] unit = ",
        ),
        (
            HEADER + "20:00:00.5,2,0,0,0,0,0,0\n",
            r"column 't': '20:00:00.5' .*; write dates and times of day as",
        ),
        ("t d n\n1 2 3\n", r"it has t d n; separate columns by commas, semicolons or tabs"),
        (HEADER + "2,2,0,0,0,0,0,0\n1,2,0,0,0,0,0,0\n", r"log\.csv, line 3, column 't': time goes back"),
        (HEADER + "\n2,2,0,0,0,0,0,0\n\n1,2,0,0,0,0,0,0\n", r"line 5, column 't': time goes back"),
        (HEADER + "0,2,0,0,0,0,0,0\n1e15,2,0,0,0,0,0,0\n", r"line 3, column 't': more than 1e\+09 s"),
    ],
)
def test_a_wrong_log_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as e:
        log_of(tmp_path, text)
    assert e.value.exit_code == 1  # of a command: the file is wrong, not its words


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2025-05-04T09:30:00.2Z", "2025-05-04T09:30:01.200000001Z"),
        ("2025-05-04 09:30:00.2", "2025/05/04 09:30:01,200000001 UTC"),
        ("2025-05-04T11:30:00.2+02:00", "2025-05-04T04:00:01.200000001-0530"),
    ],
)
@pytest.mark.parametrize("separator", [",", ";"])
def test_dates_with_times_are_seconds_since_1970_and_keep_their_digits(
    tmp_path: Path, first: str, second: str, separator: str
) -> None:
    rows = [HEADER.strip(), f'"{first}",20,0,0,0,0,0,0', f'"{second}",20,0,0,0,0,0,0']
    text = "\n".join(rows) + "\n" if separator == "," else _with_semicolons(rows)
    log = log_of(tmp_path, text, plain(time={"column": "t", "unit": "iso8601"}))
    assert log.t_s.tolist() == pytest.approx([1746351000.2, 1746351001.2])
    assert log.elapsed_s().tolist() == [0.0, 1.000000001]


def _with_semicolons(rows: list[str]) -> str:
    """Rows whose first cell alone may have commas of its own."""
    return "".join(
        re.sub(r'^("[^"]*")?(.*)$', lambda m: (m[1] or "") + m[2].replace(",", ";"), row) + "\n"
        for row in rows
    )


@pytest.mark.parametrize(
    ("unit", "cell", "message"),
    [
        (
            "s",
            "2025-05-04T09:30:00Z",
            r"'2025-05-04T09:30:00Z' is not a number; give \[time\] unit = \"iso8601\"",
        ),
        ("iso8601", "1746351000", r"line 2, column 't': '1746351000' is no date with a time such as"),
        ("iso8601", "2025-02-30T00:00:00", "is no date with a time"),
        ("iso8601", "", "is no date with a time"),
    ],
)
def test_times_that_are_not_as_the_column_file_says_are_refused_with_the_unit(
    tmp_path: Path, unit: str, cell: str, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        log_of(tmp_path, HEADER + f"{cell},20,0,0,0,0,0,0\n", plain(time={"column": "t", "unit": unit}))


def test_reading_takes_little_more_memory_than_the_file_has(tmp_path: Path) -> None:
    row = "1,20,0,0,0,0,0,0," + 4000 * "x" + "\n"
    (tmp_path / "log.csv").write_text(HEADER.strip() + ",more\n" + 1000 * row)
    read_csv(tmp_path / "log.csv", plain())  # modules are imported
    tracemalloc.start()
    try:
        read_csv(tmp_path / "log.csv", plain())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * 1000 * len(row)


def test_the_progress_of_reading_is_told(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(HEADER + 2 * ROWS_PER_REPORT * "1,20,0,0,0,0,0,0\n")
    told: list[float] = []
    read_csv(tmp_path / "log.csv", plain(), told.append)
    assert told == pytest.approx([0.0, 0.5], abs=0.05)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16", "utf-16-le"])
def test_a_log_in_another_encoding_is_to_be_saved_as_utf_8(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "log.csv").write_bytes((HEADER + "1,2,0,0,0,0,0,0,ü\n").encode(encoding))
    with pytest.raises(UsageError, match="save it as UTF-8"):
        read_csv(tmp_path / "log.csv", plain())


def test_a_recording_that_is_named_as_a_log_is_told(tmp_path: Path, recording_bytes: bytes) -> None:
    (tmp_path / "log.csv").write_bytes(recording_bytes)
    with pytest.raises(UsageError, match=r"name ending in \.mcap"):
        read_csv(tmp_path / "log.csv", plain())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"position": {"north": "lat", "east": "lon", "unit": "deg"}},
            r"\[position\] unit: unit 'deg' is an angle.*; convert latitude and longitude to metres",
        ),
        ({"time": {"column": "t", "unit": "utc"}}, "unknown unit 'utc'.*, and \"iso8601\" for dates"),
        ({"time": {"column": "t", "unit": "hours"}}, r"\[time\] unit: unknown unit 'hours'"),
        ({"range": {"column": "d", "unit": "s"}}, r"\[range\] unit: .*'s' is a time"),
        ({"range": {"column": "d", "unit": "m", "min": "3 m", "max": "2 m"}}, "below max"),
        ({"range": {"column": "d", "unit": "m", "max": "3 deg"}}, "angle"),
        ({"rang": {}}, "key 'rang' is unknown; did you mean 'range'"),
        (
            {"range": {"column": "d", "unit": "m", "minimum": 1}},
            r"key 'minimum' of \[range\] is unknown; did you mean 'min'",
        ),
        ({"range": {"unit": "m"}}, r"key 'column' of \[range\] is missing"),
        ({"mount": {"orientation": [0, 0, 0, 2]}}, "unit quaternion"),
        ({"forecast": {"horizons": []}}, "horizons"),
        ({"forecast": {"horizons": ["-1 s"]}}, "horizons"),
    ],
)
def test_a_wrong_column_file_is_refused_with_its_key(change: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        plain(**change)


def test_a_time_that_no_decimal_holds_is_read_as_a_float(tmp_path: Path) -> None:
    log = log_of(tmp_path, HEADER + "1e-99999999999999999999,200,0,0,0,0,0,0\n1,200,0,0,0,0,0,0\n")
    assert log.elapsed_s().tolist() == [0.0, 0.001]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda p: p.stem)
def test_the_examples_are_column_files(path: Path) -> None:
    assert load_columns(path).horizons_s


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ({"up": "u", "unit": "m"}, [0.0, 0.0, 3.0]),
        ({"east": "e", "unit": "m"}, [2.0, 0.0, 0.0]),
        ({"north": "n", "up": "u", "unit": "m"}, [0.0, 1.0, 3.0]),
        ({"north": "n", "east": "e", "down": "u", "unit": "m"}, [2.0, 1.0, -3.0]),
    ],
)
def test_an_axis_without_a_column_is_zero_and_its_column_need_not_be_there(
    tmp_path: Path, position: dict[str, str], expected: list[float]
) -> None:
    values = {"n": 1, "e": 2, "u": 3}
    used = [v for k, v in position.items() if k != "unit"]
    header = ",".join(["t", "d", *used])
    row = ",".join(["0", "200", *(str(values[c]) for c in used)])
    columns = parse_columns({"time": PLAIN["time"], "range": PLAIN["range"], "position": position})
    log = log_of(tmp_path, f"{header}\n{row}\n", columns)
    assert log.pose[0, :3].tolist() == expected


def test_a_depth_is_straight_down_however_the_vehicle_is_tilted(tmp_path: Path) -> None:
    columns = plain(range=DEPTH)
    log = log_of(tmp_path, HEADER + "0,400,0,0,1000,20,-30,77\n", columns)
    np.testing.assert_allclose(target_points(log, columns)[0], [0.0, 0.0, 1.0 - 4.0], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": {"unit": "m"}}, "names no column"),
        ({"position": {"up": "u", "down": "d", "unit": "m"}}, "both up and down"),
        (
            {"range": DEPTH, "mount": {"position": ["1 m", "0 m", "0 m"]}},
            "straight down",
        ),
        ({"range": {**DEPTH, "kind": "sonar"}}, "kind"),
    ],
)
def test_a_column_file_that_contradicts_itself_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        plain(**change)


def test_a_log_that_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(HEADER.encode() + b"1,2,0,0,0,0,0,0,H\xf6he\n")
    with pytest.raises(UsageError, match="no text in UTF-8"):
        read_csv(tmp_path / "log.csv", plain())


def test_a_pipe_without_a_writer_is_no_log(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.csv")
    with pytest.raises(InputFileError, match=r"log\.csv: it is a pipe out of which nothing comes"):
        read_csv(tmp_path / "log.csv", plain())


def test_a_device_is_no_log() -> None:
    with pytest.raises(InputFileError, match="cannot read log /dev/zero: it is a device"):
        read_csv("/dev/zero", plain())
