"""Columns of a CSV file with a header line; lines before it that begin with # are comments."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator

from surffollow.config.input_file import check_plain_file
from surffollow.errors import FaultError, InputFileError


def read_columns(
    file: str | os.PathLike[str], unreadable: type[FaultError] = InputFileError
) -> tuple[list[str], dict[str, list[str]]]:
    """Read a file's comments and columns, as text.

    Parameters
    ----------
    file : CSV; lines that begin with # are comments, the first other line names the columns
    unreadable : raised when it cannot be read

    Returns
    -------
    comments : text of the comment lines, without #
    columns : by name, stripped values, one per row; {} without a header line

    Raises
    ------
    FaultError
        `unreadable`: it is not there, may not be read, or is no plain file
    ValueError
        it is not UTF-8 text, names a column twice, or has a row of another length; the text says which
    """
    check_plain_file(file, unreadable)
    comments: list[str] = []
    rows: list[list[str]] = []
    try:
        with open(file, newline="", encoding="utf-8-sig") as stream:

            def lines() -> Iterator[str]:
                for line in stream:
                    if line.lstrip().startswith("#"):
                        comments.append(line.strip()[1:].strip())
                    else:
                        yield line

            rows = [[v.strip() for v in row] for row in csv.reader(lines()) if row]
    except OSError as error:
        raise unreadable(f"cannot read {file}: {error.strerror}") from None
    except csv.Error as error:
        raise ValueError(str(error)) from error
    if not rows:
        return comments, {}
    names = rows[0]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"two columns are called {', '.join(twice)}")
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(names):
            raise ValueError(f"row {number}: {len(row)} values, {len(names)} columns")
    values = list(zip(*rows[1:])) if len(rows) > 1 else [()] * len(names)
    return comments, {name: list(column) for name, column in zip(names, values)}
