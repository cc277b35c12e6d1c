"""`surffollow plot`: a recording, a CSV log or a map as a figure."""

from __future__ import annotations

import json
from pathlib import Path

import click

from surffollow.cli.option_types import COLUMNS, JSON, Finite, InputFile, OutputFile
from surffollow.cli.progress import shows_compiling


@click.command("plot")
@click.argument("file", type=InputFile(streams=True))
@click.option(
    "--out",
    type=OutputFile(),
    default=None,
    help="Figure to write: .png, .svg or .pdf.  [default: FILE with .png]",
)
@COLUMNS
@click.option("--start", type=Finite(), help="CSV: first time, in seconds of the log.")
@click.option("--end", type=Finite(), help="CSV: last time, in seconds of the log.")
@click.option("--mode", type=click.Choice(["paper", "adaptive"]), help="CSV: how to follow.")
@JSON
@shows_compiling
def plot_command(
    file: str,
    out: str | None,
    columns: str | None,
    start: float | None,
    end: float | None,
    mode: str | None,
    as_json: bool,
) -> None:
    """Draw FILE on one page: a recording (.mcap), a CSV log with --columns, or a map file.

    A recording: ground, tool, stand-off, forecast, health, latencies, map. A CSV log: ground, readings,
    forecasts against what came. A map: relief and samples of what is known. Needs the extra `plot`.
    """
    from surffollow.errors import UsageError
    from surffollow.map.formats.atomic_file import check_not_read
    from surffollow.record.figure import check_figure

    target = out or str(Path(file).with_suffix(".png"))
    check_figure(target)
    check_not_read(target, file, columns)
    is_csv = columns is not None or file.lower().endswith(".csv")
    given = {"--start": start, "--end": end, "--mode": mode}
    needless = [option for option, value in given.items() if value is not None]
    if needless and not is_csv:
        raise UsageError(f"{', '.join(needless)}: only for CSV logs")
    if is_csv:
        from surffollow.cli.csv_replay import replay_csv_log
        from surffollow.record.plot_csv import plot_csv

        replay, meaning = replay_csv_log(file, columns, start, end, mode)
        plot_csv(file, replay, meaning, target)
    elif _is_recording(file):
        from surffollow.cli.convert import report_damage
        from surffollow.cli.progress import progress_line
        from surffollow.record.plot_recording import plot_recording

        with progress_line() as show:
            progress = None if show is None else lambda part: show(f"{part:6.1%} read")
            damage = plot_recording(file, target, progress)
        report_damage(damage)
    else:
        from surffollow.map import HeightMap
        from surffollow.map.files import export

        m = HeightMap.load(file)
        export(target, m.header, m.pairs)
    click.echo(json.dumps({"out": target}) if as_json else target)


def _is_recording(file: str) -> bool:
    """Whether a file begins as recordings do, or calls itself one."""
    from surffollow.config.input_file import check_plain_file
    from surffollow.errors import RecordingError

    check_plain_file(file, RecordingError)
    try:
        with open(file, "rb") as f:
            return f.read(5) == b"\x89MCAP" or file.lower().endswith(".mcap")
    except OSError as e:
        raise RecordingError(f"cannot read {file}: {e.strerror}") from None
