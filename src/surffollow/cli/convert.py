"""`surffollow convert` and `surffollow recover`: recordings into other files."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence

import click

from surffollow.cli.option_types import JSON, InputFile, OutputFile, rate_option
from surffollow.cli.progress import shows_compiling


def report_damage(damage: Sequence[str]) -> None:
    """Say on stderr why a written file lacks parts of its recording."""
    for text in damage:
        print(f"surffollow: damaged: {text}", file=sys.stderr)


@click.command("convert")
@click.argument("files", nargs=-1, required=True, type=InputFile(), metavar="FILE...")
@click.option(
    "--to",
    type=click.Choice(["foxglove", "csv", "parquet"]),
    required=True,
    help="foxglove: channels for Foxglove and Rerun; csv, parquet (extra `parquet`): one row per sample.",
)
@click.option(
    "--out",
    type=OutputFile(),
    default=None,
    help="File to write.  [default: FILE with .foxglove.mcap, .csv or .parquet]",
)
@rate_option("Samples per second; 0: every cycle.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@JSON
@shows_compiling
def convert_command(
    files: tuple[str, ...], to: str, out: str | None, rate: float, force: bool, as_json: bool
) -> None:
    """Turn recordings into a table, or into channels for viewers; several FILEs in order become one.

    Distances, heights and health come out of the same kernels as in the service. A recording with
    another layout of the cycle log is refused. Of a damaged FILE the whole part is converted, and the rest is
    reported.
    """
    from dataclasses import asdict

    from surffollow.cli.progress import progress_line
    from surffollow.record.convert import convert

    with progress_line() as show:
        progress = None if show is None else lambda part: show(f"{part:6.1%} converted")
        done = convert(files, to, out, rate_hz=rate, force=force, progress=progress)
    report_damage(done.damage)
    if done.differing:
        text = (
            f"{done.differing} cycles came out otherwise than recorded: made by another release or machine?"
        )
        print(f"surffollow: {text}", file=sys.stderr)
    if as_json:
        click.echo(json.dumps(asdict(done)))
        return
    what = f"{done.messages} messages" if to == "foxglove" else f"{done.rows} rows"
    click.echo(f"{', '.join(done.files)}: {what}" + (f" of {done.cycles} cycles" if done.cycles else ""))


@click.command("recover")
@click.argument("file", type=InputFile())
@click.option(
    "--out",
    type=OutputFile(),
    default=None,
    help="File to write.  [default: FILE-recovered.mcap]",
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
@JSON
def recover_command(file: str, out: str | None, force: bool, as_json: bool) -> None:
    """Rewrite the whole chunks of a cut or damaged recording into a file that every reader opens."""
    from dataclasses import asdict

    from surffollow.record.recover import recover

    done = recover(file, out, force=force)
    if as_json:
        click.echo(json.dumps(asdict(done)))
        return
    lost = f"; {done.lost_bytes} bytes lost: {done.damage}" if done.damage else "; nothing was wrong with it"
    click.echo(f"{done.file}: {done.messages} messages, {done.cycles} cycles{lost}")
