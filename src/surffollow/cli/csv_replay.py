"""A CSV log through the follower: run, result files and summary of the command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from surffollow.units import numbers_text

if TYPE_CHECKING:
    from surffollow.record.columns import Columns
    from surffollow.record.csv_replay import CsvReplay

TABLES = (".csv", ".parquet")


def replay_csv_log(
    file: str, columns: str | None, start: float | None, end: float | None, mode: str | None
) -> tuple[CsvReplay, Columns]:
    """Read a CSV log by its column file and follow it.

    Parameters
    ----------
    file : str                      the log
    columns : str or None           file with the meaning of its columns
    start, end : float or None [s]  part of the log
    mode : str or None              of the follower
    """
    from surffollow.cli.progress import progress_bar
    from surffollow.config.input_file import contents_are_read
    from surffollow.errors import ConfigError, UsageError
    from surffollow.record.columns import load_columns
    from surffollow.record.csv_log import read_csv
    from surffollow.record.csv_replay import run_csv

    if columns is None:
        raise UsageError(
            f"{file} is a CSV log: say what its columns mean with --columns (see examples/columns in the "
            "source distribution)"
        )
    meaning = load_columns(columns)
    with progress_bar("reading") as progress:
        log = read_csv(file, meaning, progress)
    log = log.between(start, end)
    with progress_bar("following") as progress, contents_are_read():
        try:
            return run_csv(log, meaning, mode, progress), meaning
        except ConfigError as error:
            raise ConfigError(f"{columns}: [follow] {error}") from None
        except UsageError as error:
            raise UsageError(f"{file}: {error}") from None


def output_suffix(out: str) -> str:
    """The suffix of --out in lower case; refused where it is neither a table's nor a figure's."""
    from pathlib import Path

    from surffollow.errors import UsageError
    from surffollow.record.figure import SUFFIXES, check_figure

    suffix = Path(out).suffix.lower()
    if suffix not in (*TABLES, *SUFFIXES):
        raise UsageError(
            f"--out {out}: a table ends in {', '.join(TABLES)}, a figure in {', '.join(SUFFIXES)}"
        )
    if suffix in SUFFIXES:
        check_figure(out)
    return suffix


def _write_csv_rows(out: str, replay: CsvReplay, meaning: Columns, file: str) -> None:
    from surffollow.record.csv_replay import write_rows

    if output_suffix(out) in TABLES:
        write_rows(out, replay)
    else:
        from surffollow.record.plot_csv import plot_csv

        plot_csv(file, replay, meaning, out)


def replay_csv_command(
    file: str,
    columns: str | None,
    start: float | None,
    end: float | None,
    mode: str | None,
    out: str | None,
    map_out: str | None,
    plot: str | None,
    as_json: bool,
) -> None:
    import json

    from surffollow.record.csv_points import check_extent, map_notes, outlier_notes
    from surffollow.record.forecast_scores import summarise

    replay, meaning = replay_csv_log(file, columns, start, end, mode)
    notes: list[str] = []
    if map_out is not None:
        check_extent(file, replay.log, replay.target_m)
    if out is not None:
        _write_csv_rows(out, replay, meaning, file)
    if map_out is not None:
        from surffollow.map.files import export
        from surffollow.record.map_rebuild import map_of_points

        made = map_of_points(replay.target_m)
        export(map_out, made.header, made.pairs)
        notes = map_notes(replay.log, replay.target_m, made.grid_m)
        notes += outlier_notes(replay.log, replay.target_m)
    if plot is not None:
        from surffollow.record.plot_csv import plot_csv

        plot_csv(file, replay, meaning, plot)
    summary = summarise(file, replay, meaning)
    summary["notes"] += notes
    click.echo(json.dumps(summary) if as_json else csv_text(summary))


def _span(summary: dict[str, Any]) -> str:
    """First and last time of the log: as dates, or in seconds."""
    if "start" in summary:
        return f"{summary['start']} to {summary['end']}"
    return f"{numbers_text(summary['start_s'])} to {numbers_text(summary['end_s'])} s"


def csv_text(summary: dict[str, Any]) -> str:
    """The summary of a CSV replay as text."""

    def figure(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    lines = [
        f"{summary['file']}: {summary['readings']} readings in {summary['rows']} rows, "
        f"{_span(summary)}, {summary['mode']} mode",
        f"{'horizon [s]':>12} {'rms [m]':>10} {'no change [m]':>14} {'ratio':>7} {'n':>7}",
    ]
    for row in summary["forecast"]:
        rms, still = row["rms_m"], row["no_change_rms_m"]
        ratio = f"{rms / still:.3f}" if rms is not None and still else "-"
        lines.append(
            f"{row['horizon_s']:>12g} {figure(rms):>10} {figure(still):>14} {ratio:>7} {row['n']:>7}"
        )
    reference = summary.get("reference")
    if reference is not None:
        for what in ("height", "target"):
            d = reference[what]
            lines.append(
                f"{what} less {reference['column']}: mean {figure(d['mean_m'])} m, "
                f"std {figure(d['std_m'])} m over {d['n']} rows"
            )
    lines += [f"note: {note}" for note in summary["notes"]]
    return "\n".join(lines)
