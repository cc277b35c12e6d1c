"""`surffollow record`: a service's cycle log to files."""

from __future__ import annotations

import click

from surffollow.cli.option_types import DURATION, SERVICE_NAME, SIZE, Finite, OutputFile, rate_option


@click.command("record")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Service to record.")
@click.option("--out", type=OutputFile(), default=None, help="File to write.  [default: NAME-TIME.mcap]")
@click.option(
    "--seconds",
    type=Finite(min=0.0),
    default=None,
    help="Stop after this long. The file begins earlier: with the cycles that the service still holds.",
)
@rate_option("Samples per second of the channels for viewers; 0: only what a replay needs.")
@click.option(
    "--rotate-size", type=SIZE, default=None, help="Begin another file after so many bytes, such as 100MB."
)
@click.option("--rotate-time", type=DURATION, default=None, help="Begin another file after this long: 10min.")
@click.option(
    "--keep",
    type=click.IntRange(1),
    default=None,
    help="With --rotate-…: remove the oldest files of this recording beyond so many.",
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print the final counts as JSON.")
def record_command(
    name: str,
    out: str | None,
    seconds: float | None,
    rate: float,
    rotate_size: int | None,
    rotate_time: float | None,
    keep: int | None,
    force: bool,
    as_json: bool,
) -> None:
    """Record every cycle of a service into an MCAP file, until Ctrl-C or --seconds.

    The file replays bit for bit (`surffollow replay FILE`), and Foxglove and Rerun show its standard
    channels: poses, demands, distances, health, parameters, the map. A service that stops is
    waited for; its next start becomes another segment.
    """
    import json
    import time
    from dataclasses import asdict

    from surffollow.cli.progress import progress_line, stop_event
    from surffollow.record.session import record_service

    path = out or time.strftime(f"{name}-%Y%m%d-%H%M%S.mcap")
    with progress_line() as progress:
        counts = record_service(
            name,
            path,
            stop_event(),
            seconds=seconds,
            progress=progress,
            force=force,
            rate_hz=rate,
            rotate_bytes=rotate_size or 0,
            rotate_s=rotate_time or 0.0,
            keep=keep or 0,
        )
    if counts.cycles == 0:
        click.echo(
            f"surffollow: no cycle was recorded: service {name!r} ran none meanwhile. Look at it: "
            f"surffollow status --name {name}",
            err=True,
        )
    if as_json:
        click.echo(json.dumps({"file": counts.files[0], **asdict(counts)}))
    else:
        several = f"{counts.files[0]} … {counts.files[-1]}" if len(counts.files) > 1 else counts.files[0]
        click.echo(
            f"{several}: {counts.cycles} cycles in {counts.segments} segment(s); "
            f"lost {counts.lost_cycles} cycles ({counts.lost_words} words) in {counts.losses} place(s)"
        )
