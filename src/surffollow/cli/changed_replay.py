"""`surffollow replay --set`: a recording with other parameters, compared with what was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import click

from surffollow.cli.csv_replay import TABLES, output_suffix

if TYPE_CHECKING:
    from surffollow.record.changed_replay import ChangedParameter, ChangedReplay

SHOWN_SPANS = 20
OPEN_LOOP = (
    "open loop: the poses are those of a tool that followed the recorded demands; surffollow benchmark "
    "compares settings in a closed loop"
)


def replay_changed_command(
    file: str,
    changes: Sequence[str],
    is_csv: bool,
    others: Mapping[str, object],
    out: str | None,
    plot: str | None,
    as_json: bool,
) -> None:
    """Replay and print the comparison; exit code 1 when the recording is not whole.

    Parameters
    ----------
    file : the recording
    changes : each NAME=VALUE
    is_csv : it is a CSV log
    others : options that do not go with --set → their value, None where not given
    out, plot : figures
    as_json : print JSON
    """
    import json
    import sys
    from dataclasses import asdict

    from surffollow.cli.progress import progress_line
    from surffollow.errors import UsageError
    from surffollow.record.changed_params import read_changes

    if is_csv:
        raise UsageError(
            "--set is for recordings (.mcap); of a CSV log set parameters under [follow] of the column file"
        )
    needless = [option for option, value in others.items() if value is not None]
    if needless:
        raise UsageError(f"--set does not go with {', '.join(needless)}; leave one of them out")
    if out is not None and output_suffix(out) in TABLES:
        raise UsageError(
            f"--out {out}: a table shows the recorded parameters; leave --set out, or take --json or a figure"
        )
    values = read_changes(changes)
    from surffollow.record.changed_replay import replay_changed
    from surffollow.record.plot_changed import plot_changed

    with progress_line() as show:
        progress = None if show is None else lambda part: show(f"{part:6.1%} replayed")
        report, outcomes = replay_changed(file, values, progress)
    for target in (plot, out):
        if target is not None:
            plot_changed(file, report, outcomes, target)
    click.echo(json.dumps(asdict(report)) if as_json else changed_text(file, report))
    if report.damage:
        sys.exit(1)


def changed_text(file: str, r: ChangedReplay) -> str:
    """A comparison as text."""
    from surffollow.units import length_unit

    factor, unit = length_unit(r.standoff_m)
    lines = [f"{file}: {r.cycles} cycles in {r.segments} segment(s), {r.seconds:.3f} s"]
    lines += [f"{'changed':<10}{_change(p)}" for p in r.parameters]
    lines.append(f"{'demand':<10}differs in {r.differing_share:.2%} of the cycles")
    if r.z_rms_m is None or r.z_max_m is None:
        lines.append(f"{'demand.z':<10}not compared: no cycle has a valid demand in both")
    else:
        lines.append(
            f"{'demand.z':<10}difference RMS {factor * r.z_rms_m:.4g} {unit}, greatest "
            f"{factor * r.z_max_m:.4g} {unit} at {r.z_max_at_s:.3f} s ({r.z_compared} cycles "
            "with a valid demand in both)"
        )
    lines.append(
        f"{'VALID':<10}{r.valid_share_recorded:.2%} of the time as recorded, {r.valid_share:.2%} with the "
        f"change, {r.valid_share_both:.2%} in both"
    )
    lines += _health_lines(r)
    if r.otherwise:
        lines.append(
            f"{'note':<10}{r.otherwise} cycles came out otherwise than recorded with the recorded parameters "
            "(another release?): the comparison is with this release"
        )
    if r.note:
        lines.append(f"{'note':<10}as recorded, {r.note}")
    lines += [f"DAMAGED: {text}" for text in r.damage]
    return "\n".join([*lines, f"{'note':<10}{OPEN_LOOP}"])


def _health_lines(r: ChangedReplay) -> list[str]:
    if not r.health_compared:
        return [f"{'health':<10}not compared: the paper's mode has none"]
    n = len(r.health_spans) + r.health_spans_left_out
    share = r.health_differing / r.health_compared
    lines = [f"{'health':<10}or its reason differs {share:.2%} of the time, {n} time(s)"]
    for s in r.health_spans[:SHOWN_SPANS]:
        recorded, changed = (
            f"{health} ({reason})" if reason else health
            for health, reason in ((s.recorded_health, s.recorded_reason), (s.health, s.reason))
        )
        lines.append(f"{'':<10}{s.begin_s:.3f} to {s.end_s:.3f} s: {recorded} → {changed}")
    if n > SHOWN_SPANS:
        lines.append(f"{'':<10}and {n - SHOWN_SPANS} more; --json lists them")
    return lines


def _change(p: ChangedParameter) -> str:
    """A parameter's recorded values and that of the replay."""
    first, *later = p.recorded
    recorded = value_text(p.name, first[1])
    recorded += "".join(f", from {t_s:.3f} s on {value_text(p.name, v)}" for t_s, v in later[:5])
    recorded += f" and {len(later) - 5} more" if len(later) > 5 else ""
    new = value_text(p.name, p.value)
    return f"{p.name} {recorded} → {new}" + (" (as recorded)" if new == recorded else "")


def value_text(name: str, value: float) -> str:
    """The value of a parameter, in the parameter's unit, for people."""
    from surffollow.config.params import PARAMS
    from surffollow.units import format_ns, length_unit

    spec = PARAMS[name]
    if spec.choices:
        return spec.choices[int(value)]
    if spec.unit in ("s", "ns"):
        return format_ns(value * (1e9 if spec.unit == "s" else 1.0))
    factor, unit = length_unit(value) if spec.unit == "m" else (1.0, spec.unit)
    return f"{factor * value:.6g}" + ("" if unit == "1" else f" {unit}")
