"""Tables of measured numbers that commands read: what is no number is refused with its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from surffollow.errors import ScanFileError, SurffollowError, UsageError
from surffollow.record.csv_cells import read_numbers
from surffollow.scan.spot_files import read_spots
from surffollow.sim.path_table import read_path_table


def read_pairs(file: str) -> object:
    return read_numbers(file, ("x_m", "y_m"))


@pytest.mark.parametrize(
    ("read", "error"), [(read_pairs, UsageError), (read_path_table, UsageError), (read_spots, ScanFileError)]
)
def test_digits_grouped_by_underscores_are_refused(
    tmp_path: Path, read, error: type[SurffollowError]
) -> None:
    """Python takes 1_5 for 15."""
    text = "x_m,y_m,correction_m\n0,0,0\n{},1,0\n"
    if read is read_path_table:
        text = "x_m,y_m\n0,0\n{},1\n"
    file = tmp_path / "table.csv"
    file.write_text(text.format("1.5"))
    read(str(file))
    file.write_text(text.format("1_5"))
    with pytest.raises(error, match="1_5"):
        read(str(file))


def test_spots_with_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    """The last one would be taken."""
    file = tmp_path / "spots.csv"
    file.write_text("x_m,y_m,correction_m,correction_m\n0,0,0.001,0.9\n1,0,0.002,0.9\n")
    with pytest.raises(ScanFileError, match="two columns are called correction_m"):
        read_spots(file)
