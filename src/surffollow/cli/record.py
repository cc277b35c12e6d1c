"""`surffollow record` and `surffollow replay`: cycle logs to files, and files through the kernels again."""

from __future__ import annotations

import click


@click.command("record")
@click.option("--name", default="surf", show_default=True, help="Service to record.")
@click.option(
    "--out", type=click.Path(dir_okay=False), default=None, help="File to write.  [default: NAME-TIME.mcap]"
)
@click.option("--seconds", type=click.FloatRange(min=0.0), default=None, help="Stop after this long.")
@click.option("--json", "as_json", is_flag=True, help="Print the final counts as JSON.")
def record_command(name: str, out: str | None, seconds: float | None, as_json: bool) -> None:
    """Record every cycle of a service into an MCAP file, until Ctrl-C or --seconds.

    The file replays bit for bit (`surffollow replay FILE`). A service that stops is
    waited for; its next start becomes another segment.
    """
    import json
    import signal
    import sys
    import threading
    import time
    from dataclasses import asdict

    from surffollow.record.session import record_service

    path = out or time.strftime(f"{name}-%Y%m%d-%H%M%S.mcap")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    on_terminal = sys.stderr.isatty()

    def progress(line: str) -> None:
        sys.stderr.write(f"\r\x1b[K{line}")
        sys.stderr.flush()

    counts = record_service(name, path, stop, seconds=seconds, progress=progress if on_terminal else None)
    if on_terminal:
        sys.stderr.write("\n")
    if as_json:
        click.echo(json.dumps({"file": path, **asdict(counts)}))
    else:
        click.echo(
            f"{path}: {counts.cycles} cycles in {counts.segments} segment(s); "
            f"lost {counts.lost_cycles} cycles ({counts.lost_words} words) in {counts.losses} place(s)"
        )


@click.command("replay")
@click.argument("file", type=click.Path())
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def replay_command(file: str, as_json: bool) -> None:
    """Run a recording through the same kernels again and compare every bit.

    Exit code 1 when anything differs or the file is damaged.
    """
    import json
    import sys
    from dataclasses import asdict

    from surffollow.record.replay import replay_file

    report = replay_file(file)
    click.echo(json.dumps(asdict(report)) if as_json else report_text(file, report))
    if not report.identical:
        sys.exit(1)


def report_text(file: str, report: object) -> str:
    """A `ReplayReport` for people."""
    from surffollow.record.replay import ReplayReport

    assert isinstance(report, ReplayReport)
    r = report
    lines = [
        f"{file}: {r.cycles} cycles in {r.segments} segment(s), recorded by surffollow {r.recorded_by} "
        f"on {r.machine}; {r.lost_cycles} cycles lost in {r.losses} place(s)",
        f"replayed at {r.cycles_per_s / 1e6:.2f} million cycles/s",
    ]
    if not r.complete:
        lines.append(f"DAMAGED: {r.damage}; {r.lost_bytes} bytes lost; judged is only what is whole")
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
    return "\n".join(lines)
