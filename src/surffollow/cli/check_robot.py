"""`surffollow check-robot`: poses and ranges of a robot against each other, before demands are applied."""

from __future__ import annotations

import contextlib
import json
import math
import sys
from typing import Any

import click

from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite

LONGEST_S = 120.0
LOOK_S = 0.05
LOOKS_PER_LINE = 10


@click.command("check-robot")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service.")
@click.option(
    "--seconds",
    type=Finite(1.0, 3600.0),
    help=f"Length of the watch [until the tool moved enough, {LONGEST_S:g} at most].",
)
@JSON
def check_robot_command(name: str, seconds: float | None, as_json: bool) -> None:
    """Compare ranges with reported heights while you move the tool up and down: frame, units, lag.

    Apply no demands, and move the tool by the robot's own means over one spot of level ground: some
    20 % of the stand-off, up and down, twice or more. The command only reads. Ctrl-C ends the watch
    with what is known. Range per height, the gain, has to be 1 for every channel.

    Exit codes, also after Ctrl-C: 0 all is right; 1 something is wrong, or the motion was not enough.
    """
    from surffollow.apps.gain_verdict import length
    from surffollow.apps.robot_check import PART, RobotCheck
    from surffollow.cli.json_values import without_nan
    from surffollow.cli.progress import progress_line, stop_event

    with contextlib.closing(RobotCheck(name)) as check:
        stop = stop_event()
        click.echo(
            f"Move the tool up and down by {length(2 * PART * check.standoff_m)} over one spot of level "
            "ground, twice or more, by the robot's own means. Apply no demands. Ctrl-C ends the watch.",
            err=True,
        )
        with progress_line() as show:
            looks = 0
            while not (stop.wait(LOOK_S) or check.has_ended):
                check.take()
                looks += 1
                if looks % LOOKS_PER_LINE:
                    continue
                if show is not None:
                    show(check.progress())
                if check.seconds() >= (seconds or LONGEST_S) or (seconds is None and check.is_enough()):
                    break
        check.take()
        report = check.report()
    if as_json:
        print(json.dumps(without_nan(report), indent=2, allow_nan=False))
    else:
        print("\n".join(render(report)))
    if not report["is_right"]:
        sys.exit(1)


def render(r: dict[str, Any]) -> list[str]:
    """The result as lines of text."""
    from surffollow.apps.gain_verdict import length

    motion = r["motion"]
    height, needed, x, y = (length(motion[n]) for n in ("height_m", "needed_m", "x_m", "y_m"))
    lines = [
        f"service  {r['name']}, watched for {r['seconds']:.1f} s, {r['reports']} pose reports",
        f"motion   height {height} in {motion['moves']} moves up or down ({needed} needed), "
        f"sideways x {x}, y {y}",
    ]
    if r["channels"]:
        lines.append(f"{'channel':<9}{'gain, range per height':<24}{'lag, configured':<28}{'noise':<13}range")
    lines += [_channel_line(c) for c in r["channels"]]
    verdicts = [("", motion)] if motion["verdict"] != "OK" else []
    verdicts += [(f"channel {c['channel']}: ", c) for c in r["channels"]]
    for who, found in verdicts:
        if found is not motion and found["verdict"] == motion["verdict"] != "OK":
            continue  # the motion has a line of its own
        lines.append(f"{found['verdict'].upper():<7}  {who}{found['text']}")
        if found["remedy"]:
            lines.append(f"{'remedy':<9}{found['remedy']}")
    for name in ("poses", "conversions", "ranges"):
        if r[f"{name}_refused"]:
            lines.append(
                f"{'note':<9}the service refused {r[f'{name}_refused']} {name} meanwhile; timestamps are "
                "those of CLOCK_MONOTONIC in ns"
            )
    if r["lost"]:
        lines.append(f"{'note':<9}parts of the cycle log were overwritten before they were read: {r['lost']}")
    if r["has_ended"]:
        lines.append(f"{'note':<9}the service ended during the watch")
    if r["note"]:
        lines.append(f"{'note':<9}{r['note']}")
    if r["is_right"]:
        lines.append(
            f"{'compare':<9}the robot's own display with the height above, {height}: "
            "a wrong unit of heights and ranges alike shows only there"
        )
    return lines


def _channel_line(c: dict[str, Any]) -> str:
    """Numbers of a channel as a line."""
    from surffollow.apps.gain_verdict import length

    if c["gain"] is None:
        gain = lag = noise = "-"
    else:
        sigma = max(c["gain_sigma"], 1e-4 * max(abs(c["gain"]), 0.01))
        digits = max(0, -math.floor(math.log10(sigma)))
        gain = f"{c['gain']:.{digits}f} ± {sigma:.{digits}f}"
        lag = "not identified"
        if c["lag_s"] is not None:
            lag = f"{1e3 * c['lag_s'] + 0.0:.1f} ± {max(1e3 * c['lag_sigma_s'], 0.1):.1f} ms"
        lag += f", {1e3 * c['latency_s']:.3g} ms"
        noise = length(c["noise_m"])
    where = "no reading" if c["range_m"] is None or math.isnan(c["range_m"]) else length(c["range_m"])
    return f"{c['channel']:<9}{gain:<24}{lag:<28}{noise:<13}{where}"
