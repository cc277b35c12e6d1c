"""Outputs of a command that cannot be, said before long work."""

from __future__ import annotations

import os
from collections.abc import Iterable

import click


def check_outputs(
    outputs: Iterable[str | os.PathLike[str] | None], inputs: Iterable[str | os.PathLike[str] | None] = ()
) -> None:
    """Refuse outputs that take the place of an input or of each other, or cannot be written.

    None stands for an option that is not given.

    Raises
    ------
    click.UsageError
        two of the names are one file
    MapFileError
        the place cannot be written
    """
    from surffollow.map.formats.atomic_file import check_place

    taken = {os.path.realpath(i): "is read by this command" for i in inputs if i is not None}
    for output in outputs:
        if output is None:
            continue
        real = os.path.realpath(output)
        if real in taken:
            raise click.UsageError(f"{output} {taken[real]}; choose another name to write")
        taken[real] = "is written twice"
        check_place(output)
