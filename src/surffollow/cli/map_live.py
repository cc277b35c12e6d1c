"""`surffollow map upload`, `map install` and `map reset`: the map of a running service."""

from __future__ import annotations

import click

from surffollow.cli.clipped_heights import warn_of_clipped
from surffollow.cli.facts import print_facts
from surffollow.cli.map_facts import map_facts
from surffollow.cli.option_types import (
    JSON,
    LENGTH,
    SERVICE_NAME,
    Finite,
    InputFile,
    OutputFile,
    SignedArguments,
)
from surffollow.cli.progress import progress_bar

_NAME = click.option(
    "--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service."
)
_TIMEOUT = click.option(
    "--timeout",
    "timeout_s",
    default=30.0,
    show_default=True,
    type=Finite(min=0.1),
    help="Seconds to wait for the service.",
)


@click.command("upload")
@click.argument("file", type=OutputFile())
@_NAME
@_TIMEOUT
@JSON
def upload_command(file: str, name: str, timeout_s: float, as_json: bool) -> None:
    """Write the map of a running service to FILE, in the format of its suffix; an old file is replaced.

    .txt, .map (the same text) and .npz are lossless; the others are those of `map export`.
    """
    from pathlib import Path

    from surffollow.client import attach
    from surffollow.client.map_reader import copy_live_map
    from surffollow.map import HeightMap
    from surffollow.map.files import check_suffix, export

    check_suffix(file)
    with attach(name, label="map upload") as client, progress_bar("writing") as progress:
        header, pairs = copy_live_map(client, timeout_s)
        export(Path(file), header, pairs, progress=progress)
    if as_json:
        print_facts(map_facts(HeightMap(header, pairs)) | {"out": file}, as_json)
    warn_of_clipped(header)


@click.command("install")
@click.argument("file", type=InputFile())
@_NAME
@_TIMEOUT
@JSON
def install_command(file: str, name: str, timeout_s: float, as_json: bool) -> None:
    """Put a map FILE in the place of a running service's map; following goes on meanwhile.

    FILE is the map's text file, .npz, an ESRI ASCII grid or a GeoTIFF, with any suffix.
    It is checked as a whole first. Interrupted after that, the map is empty.
    """
    from surffollow.client import attach

    with attach(name, label="map install") as client, progress_bar("installing") as progress:
        client.map_install(file, timeout_s=timeout_s, progress=progress)
        if as_json:
            print_facts(client.map_facts(), as_json)


@click.command("reset", cls=SignedArguments)
@click.argument("region", nargs=4, type=LENGTH, metavar="X_MIN Y_MIN X_MAX Y_MAX")
@_NAME
@_TIMEOUT
@JSON
def reset_command(
    region: tuple[float, float, float, float], name: str, timeout_s: float, as_json: bool
) -> None:
    """Clear a running service's map and lay it over a region (MapReset).

    The configuration's access.map says who may do that: by default the client that sends the pose, and
    any client while nobody sends it.
    """
    from surffollow.client import attach

    with attach(name, label="map reset") as client:
        client.map_reset(region, timeout_s=timeout_s)
        if as_json:
            print_facts(client.map_facts(), as_json)
