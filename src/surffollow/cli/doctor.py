"""`surffollow doctor` and `surffollow latency`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from surffollow.cli.option_types import JSON, Finite
from surffollow.cli.progress import shows_compiling
from surffollow.errors import UsageError

_MARKS = {"good": "ok", "fair": "fair", "lacking": "LACKS", "unknown": "?"}
_BAR = 50


@click.command("doctor")
@JSON
@click.option(
    "--unit", type=click.Path(), metavar="FILE", help="Check this systemd unit file instead of the machine."
)
def doctor_command(as_json: bool, unit: str | None) -> None:
    """Say what this machine lacks for hard timing, why it matters and how to get it. Changes nothing.

    Exit code 0 also where something is lacking: the service runs without it. The last line names what
    is lacking, with --json the list `lacking`.

    With --unit: what systemd-analyze says of a unit file, where that is installed. An example of a unit, and
    the udev rule, are in the folder systemd of the installed package.
    """
    from surffollow.service.doctor import examine, machine
    from surffollow.service.doctor_unit import examine_unit

    findings = examine() if unit is None else examine_unit(Path(unit))
    lacking = [f.name for f in findings if f.state == "lacking"]
    if as_json:
        checks = [f.as_dict() for f in findings]
        print(json.dumps({"machine": machine(), "lacking": lacking, "checks": checks}, indent=2))
        return
    m = machine()
    print(f"{m['machine']}, Linux {m['kernel']}, {m['allowed']} of {m['processors']} processors allowed")
    width = max(len(f.name) for f in findings)
    for f in findings:
        print(f"{_MARKS[f.state]:>5}  {f.name:<{width}}  {f.found}")
        if f.state != "good":
            print(f"{'':7}{'':{width}}  why: {f.why}")
            if f.remedy:
                print(f"{'':7}{'':{width}}  get: {f.remedy}")
    print(f"{len(lacking)} of {len(findings)} lacking" + (f": {', '.join(lacking)}" if lacking else ""))
    if unit is None:
        print("measure what comes of it: surffollow latency")


def _duration(low_s: float, high_s: float) -> Callable[[click.Context, click.Parameter, str], int]:
    """Option callback for a duration between bounds; a bare number is in seconds. The command gets ns."""

    def parse(ctx: click.Context, param: click.Parameter, value: str) -> int:
        from surffollow.units import parse_quantity

        try:
            duration_s = parse_quantity(value, "s", bare=True)
        except UsageError as error:
            raise click.BadParameter(str(error), ctx, param) from None
        if not low_s <= duration_s <= high_s:
            bounds = f"{low_s:.7f}".rstrip("0").rstrip(".") + f" to {high_s:g} s"
            raise click.BadParameter(f"{value!r} is not in the range of {bounds}", ctx, param)
        return round(duration_s * 1e9)

    return parse


@click.command("latency")
@click.option(
    "--seconds", type=Finite(0.01, 3600.0), default=3.0, show_default=True, help="Length of each run."
)
@click.option(
    "--period",
    callback=_duration(20e-6, 1.0),
    default="1 ms",
    show_default=True,
    help="Time between wake-ups, 20 us to 1 s.",
)
@click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=2,
    show_default=True,
    help="Runs of ours, alternating with cyclictest's.",
)
@click.option(
    "--spin",
    callback=_duration(0.0, 0.01),
    default="120 us",
    show_default=True,
    help="Spin that long before each deadline, up to 10 ms.",
)
@click.option(
    "--priority", type=click.IntRange(1, 99), default=80, show_default=True, help="SCHED_FIFO priority."
)
@click.option(
    "--cpu",
    type=click.IntRange(-1),
    default=-1,
    show_default=True,
    help="Processor; -1: the last one allowed.",
)
@click.option("--cyclictest/--no-cyclictest", "beside", default=True, help="Run cyclictest in between.")
@JSON
@shows_compiling
def latency_command(
    seconds: float,
    period: int,
    runs: int,
    spin: int,
    priority: int,
    cpu: int,
    beside: bool,
    as_json: bool,
) -> None:
    """Measure how late the service's own wait wakes up here: percentiles and a histogram."""
    import os

    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, allowed if cpu < 0 else {cpu})
    except (OSError, OverflowError, ValueError):
        raise UsageError(
            f"--cpu {cpu} is no processor that this process may use; give one of {sorted(allowed)}"
        ) from None
    os.sched_setaffinity(0, allowed)
    from surffollow.service.doctor_latency import measure

    result = measure(
        period_ns=period,
        seconds=seconds,
        runs=runs,
        spin_ns=spin,
        priority=priority,
        beside=beside,
        cpu=cpu,
    )
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        print("\n".join(render(result)))


def render(r: dict[str, Any]) -> list[str]:
    """The measurement as lines of text."""
    from surffollow.units import format_ns

    runs = len(r["runs"])
    lines = [
        f"wake-up lateness every {format_ns(r['period_ns'])}, {runs} runs of {r['seconds']:g} s, "
        f"spin {format_ns(r['spin_ns'])}, load {r['load']:.1f}",
        f"granted: {', '.join(r['granted']) or 'nothing'}"
        + (f"; refused: {'; '.join(r['refused'])}" if r["refused"] else ""),
        f"{'':<12}{'p50':>10}{'p99':>10}{'p99.9':>10}{'max':>10}{'wake-ups':>10}{'overruns':>10}",
    ]
    for name in ("ours", "cyclictest"):
        s = r[name]
        if s is None:
            lines.append(f"{name:<12}not measured: {r['why']}")
            continue
        figures = "".join(f"{format_ns(s[k]):>10}" for k in ("p50_ns", "p99_ns", "p99_9_ns", "max_ns"))
        overruns = s["overruns"] if name == "ours" else "-"
        lines.append(f"{name:<12}{figures}{s['wakeups']:>10}{overruns:>10}")
    lines += ["", "ours, by octave:"]
    octaves = _octaves(r["ours"]["histogram"])
    most = max((n for _, n in octaves), default=1)
    for low, n in octaves:
        lines.append(f"{'< ' + format_ns(2 * low):>10} {n:>9} {'#' * max(1, round(_BAR * n / most))}")
    return lines


def _octaves(bins: list[dict[str, Any]]) -> list[tuple[float, int]]:
    """Bins gathered by powers of two: (lower edge [ns], count)."""
    out: dict[float, int] = {}
    for b in bins:
        low = 2.0 ** (int(b["from_ns"]).bit_length() - 1) if b["from_ns"] >= 1 else 0.5
        out[low] = out.get(low, 0) + b["count"]
    return sorted(out.items())
