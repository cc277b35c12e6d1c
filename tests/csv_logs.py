"""CSV logs and column files for tests."""

from __future__ import annotations

from pathlib import Path

from surffollow.record.columns import Columns, parse_columns
from surffollow.record.csv_log import CsvLog, read_csv

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples" / "columns"
PLAIN = {
    "time": {"column": "t", "unit": "ms"},
    "range": {"column": "d", "unit": "cm", "min": "5 cm", "max": "10 m", "no_reading": [0, 999]},
    "position": {"north": "n", "east": "e", "up": "u", "unit": "mm"},
    "attitude": {"roll": "roll", "pitch": "pitch", "yaw": "yaw", "unit": "deg"},
    "forecast": {"horizons": ["1 s"], "match": "0.3 s"},
    "follow": {"interval_size": "0.5 m", "range_size": 2, "ee_readings": 1},
}
HEADER = "t,d,n,e,u,roll,pitch,yaw\n"


def plain(**changes: object) -> Columns:
    return parse_columns(PLAIN | changes)


def log_of(tmp_path: Path, text: str, columns: Columns | None = None) -> CsvLog:
    path = tmp_path / "log.csv"
    path.write_text(text)
    return read_csv(path, columns or plain())
