"""`surffollow replay`: recordings and CSV logs through the kernels again."""

from __future__ import annotations

import click

from surffollow.cli.clipped_heights import warn_of_clipped
from surffollow.cli.convert import report_damage
from surffollow.cli.csv_replay import TABLES, output_suffix, replay_csv_command
from surffollow.cli.option_types import COLUMNS, JSON, SERVICE_NAME, InputFile, LogTime, OutputFile
from surffollow.cli.progress import shows_compiling
from surffollow.errors import escaped


@click.command("replay")
@click.argument("file", type=InputFile(streams=True))
@JSON
@COLUMNS
@click.option("--start", type=LogTime(), help="CSV: first time, in seconds of the log or as a date.")
@click.option("--end", type=LogTime(), help="CSV: last time, in seconds of the log or as a date.")
@click.option("--mode", type=click.Choice(["paper", "adaptive"]), help="CSV: how to follow.")
@click.option(
    "--out",
    type=OutputFile(),
    help="Write a table (.csv; of a recording also .parquet, 100 rows/s) or a figure (.png, .svg, .pdf).",
)
@click.option("--plot", type=OutputFile(), help="Draw a figure (.png, .svg, .pdf), as `plot` does.")
@click.option(
    "--map",
    "map_out",
    type=OutputFile(),
    help="Also build the run's map again: where to; the suffix says how.",
)
@click.option(
    "--live", is_flag=True, help="Play the recording into a service started for it, at its own pace."
)
@click.option("--name", type=SERVICE_NAME, help="Name of that service.  [default: replay-PID]")
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="NAME=VALUE",
    help="Another value of a parameter for the whole run, such as plant_tau='50 ms'; may be repeated.",
)
@shows_compiling
def replay_command(
    file: str,
    as_json: bool,
    columns: str | None,
    start: float | None,
    end: float | None,
    mode: str | None,
    out: str | None,
    plot: str | None,
    map_out: str | None,
    live: bool,
    name: str | None,
    changes: tuple[str, ...],
) -> None:
    """Run a recording through the same kernels again and compare every bit.

    Exit code 1 when anything differs, or when the recording or a file written of it is not whole.
    A CSV log with --columns is followed as it stands; the ranges forecast ahead are compared with those
    that came.

    With --set the kernels get other parameters, and the demands are compared with the recorded ones. The
    poses stay those of a tool that followed the recorded demands: an open-loop comparison. `benchmark`
    compares settings in a closed loop. Differences are no fault then.
    """
    from surffollow.errors import UsageError

    if name is not None and not live:
        raise UsageError("--name goes with --live")
    for target in (out, plot, map_out):
        if target is not None:
            from surffollow.map.formats.atomic_file import check_not_read

            check_not_read(target, file, columns)
    suffix = None if out is None else output_suffix(out)
    if plot is not None:
        from surffollow.record.figure import check_figure

        check_figure(plot)
    if map_out is not None:
        from surffollow.map.files import check_suffix

        check_suffix(map_out)
    is_csv = columns is not None or file.lower().endswith(".csv")
    if changes:
        from surffollow.cli.changed_replay import replay_changed_command

        others = {"--start": start, "--end": end, "--mode": mode, "--map": map_out, "--live": live or None}
        replay_changed_command(file, changes, is_csv, others, out, plot, as_json)
    elif is_csv:
        if live:
            raise UsageError("--live is for recordings (.mcap), not CSV logs")
        if suffix == ".parquet":
            raise UsageError(f"--out {out}: the table of a CSV log is a .csv file")
        replay_csv_command(file, columns, start, end, mode, out, map_out, plot, as_json)
    else:
        given = {"--start": start, "--end": end, "--mode": mode}
        needless = [option for option, value in given.items() if value is not None]
        if needless:
            raise UsageError(
                f"{', '.join(needless)}: only for CSV logs; a recording is played as it was made"
            )
        if map_out is not None:
            _write_map(file, map_out)
        damage = _write_outputs(file, out, plot, suffix)
        if live:
            _end_with(damage + _play_live(file, name, as_json))
        else:
            _replay_recording(file, as_json, damage)


def _write_outputs(file: str, out: str | None, plot: str | None, suffix: str | None) -> list[str]:
    """Write table and figures; for each that is not whole, its name and the damage."""
    damage = []
    for figure in (plot, out if suffix not in TABLES else None):
        if figure is not None:
            from surffollow.record.plot_recording import plot_recording

            damage += [f"{figure}: {text}" for text in plot_recording(file, figure)]
    if out is not None and suffix in TABLES:
        from surffollow.record.convert import convert

        done = convert([file], "parquet" if suffix == ".parquet" else "csv", out, force=True)
        damage += [f"{out}: {text}" for text in done.damage]
    return damage


def _write_map(file: str, map_out: str) -> None:
    from surffollow.map.files import export
    from surffollow.record.left_out import listed
    from surffollow.record.map_rebuild import rebuild_map

    rebuilt, left_out = rebuild_map(file)
    export(map_out, rebuilt.header, rebuilt.pairs)
    warn_of_clipped(rebuilt.header)
    if left_out:
        lacking = f"without the target points and map commands of {listed(left_out)}"
        report_damage([f"{map_out}: {lacking}, which are lost or stand between a loss and a snapshot"])


def _play_live(file: str, name: str | None, as_json: bool) -> list[str]:
    """Play it and print the counts; what was left out."""
    import json
    from dataclasses import asdict

    from surffollow.cli.progress import progress_line, stop_event
    from surffollow.record.left_out import listed
    from surffollow.record.live_replay import play_live

    with progress_line() as progress:
        r = play_live(file, name=name, stop=stop_event(), progress=progress)
    if as_json:
        click.echo(json.dumps(asdict(r)))
    else:
        click.echo(
            f"{file}: {r.conversions} conversions ({r.conversions_skipped} skipped) and {r.poses} poses "
            f"({r.poses_refused} refused) in "
            f"{r.seconds:.1f} s, {r.cycles} cycles; {r.valid} of {r.poses} demands valid"
            + ("" if r.finished else "; ended early")
            + (f"; recovered from a damaged file: {escaped(r.recovered)}" if r.recovered else "")
        )
    return [f"{file}: not played: {listed(r.left_out)}"] if r.left_out else []


def _end_with(damage: list[str]) -> None:
    """Exit code 1 when a written file or the recording is not whole."""
    import sys

    report_damage(damage)
    if damage:
        sys.exit(1)


def _replay_recording(file: str, as_json: bool, damage: list[str]) -> None:
    import json
    import sys
    from dataclasses import asdict

    from surffollow.record.replay import replay_file

    report = replay_file(file)
    if as_json:
        click.echo(json.dumps(asdict(report) | {"output_damage": damage}))
    else:
        click.echo("\n".join([report_text(file, report), *(f"NOT WHOLE: {text}" for text in damage)]))
    if damage or not report.identical:
        sys.exit(1)


def report_text(file: str, report: object) -> str:
    """A `ReplayReport` as text."""
    from surffollow.record.left_out import listed
    from surffollow.record.replay import ReplayReport

    assert isinstance(report, ReplayReport)
    r = report
    lines = [
        f"{file}: {r.cycles} cycles in {r.segments} segment(s), recorded by surffollow {r.recorded_by} "
        f"on {r.machine}; the recorder lost {r.lost_cycles} cycles in {r.losses} place(s)",
        f"replayed at {r.cycles_per_s / 1e6:.2f} million cycles/s",
    ]
    if not r.complete:
        lines.append(
            f"DAMAGED: {r.damage}; {r.lost_bytes} bytes lost; {r.cycles_not_replayed} cycles not replayed "
            "(in the damage, and behind it up to the next snapshot"
            + (f": {listed(r.left_out)}" if r.left_out else "")
            + "); the other whole entries were compared"
        )
    if r.recovered:
        lines.append(f"RECOVERED from a damaged file: {r.recovered}")
    if r.differing:
        lines.append(f"DIFFERENT: {r.differing} cycles; first {r.first_difference}")
    if r.states_differing:
        lines.append(
            f"DIFFERENT: {r.states_differing} of {r.snapshots} snapshots are not the replayed state; "
            f"first before cycle {r.first_state_difference}"
        )
    if r.gaps:
        lines.append(f"DIFFERENT: {r.gaps} cycle numbers do not follow the ones before")
    if r.identical:
        lines.append(f"identical: every demand and status, and {r.snapshots} snapshots, bit for bit")
    if r.note:
        lines.append(f"note: {r.note}")
    return escaped("\n".join(lines))  # the file's author chose some of these texts
