"""`surffollow blocks ls`, `show`, `watch`, `record`, `rm` and `print-header`."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from surffollow.cli.json_values import without_nan
from surffollow.cli.old_names import old_name
from surffollow.cli.option_types import JSON, Finite, OutputFile
from surffollow.errors import escaped
from surffollow.units import numbers_text

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from surffollow.blocks import AttachedBlock

WATCH_POLL_S = 0.001


@click.group("blocks")
def blocks_group() -> None:
    """List, show, watch, record and remove shared blocks (NAME.BLOCK), without disturbing who uses them."""


@blocks_group.command("ls")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON array.")
def list_command(as_json: bool) -> None:
    """List the blocks of this machine: schema, writer, generation, age."""
    from surffollow.blocks.listing import list_blocks, unreadable_objects

    found, hidden = list_blocks(), unreadable_objects()
    if as_json:
        print(json.dumps(found + hidden, indent=2))
        return
    if hidden:
        names = ", ".join(f"{b['name']} (user {b['owner']})" for b in hidden)
        print(f"not readable, perhaps blocks: {names}; join their group (ls -l /dev/shm)", file=sys.stderr)
    if not found and not hidden:
        print("no blocks; a program makes one with surffollow.blocks.mem_attach(..., write=True)")
        return
    if not found:
        return
    rows = [("BLOCK", "SCHEMA", "BYTES", "WRITER", "GENERATION", "AGE")]
    for b in found:
        row = (b["name"], b["schema"], b["bytes"], _writer(b), b["generation"], _age(b["age_s"]))
        rows.append(tuple(str(v) for v in row))  # type: ignore[arg-type]
    widths = [max(len(r[k]) for r in rows) for k in range(len(rows[0]))]
    for r in rows:
        print("  ".join(v.ljust(w) for v, w in zip(r, widths)).rstrip())


def _writer(b: dict[str, Any]) -> str:
    return f"{b['writer_pid']}" if b["writer_alive"] else f"{b['writer_pid']} (dead)"


def _age(age_s: float | None) -> str:
    from surffollow.units import format_ns

    return "never written" if age_s is None else format_ns(age_s * 1e9)


@blocks_group.command("show")
@click.argument("block")
@JSON
def show_command(block: str, as_json: bool) -> None:
    """Show the newest values of BLOCK (NAME.BLOCK) with their units; the block brings its own schema."""
    from surffollow.blocks.listing import attach_unknown, describe_block
    from surffollow.config.trusted_users import trusted_owners

    attached = attach_unknown(block, trusted_owners())
    try:
        about = describe_block(attached)
        snapshot = attached.latest()
        values = snapshot.values.as_dict()
    finally:
        attached.close()
    if as_json:
        fields = [
            {"name": n, "type": f.code, "count": f.count, "unit": f.unit, "doc": f.doc}
            for n, _, f in attached.schema.walk()
        ]
        said = {**about, "stale": snapshot.stale, "values": without_nan(values), "fields": fields}
        print(json.dumps(said, indent=2))
        return
    age = _age(about["age_s"])
    print(f"{about['name']}: {about['schema']} {about['hash']}, {about['bytes']} bytes")
    print(f"writer {_writer(about)}, epoch {about['epoch']}, generation {about['generation']}, age {age}")
    for line in _value_lines(attached.schema, values, ""):
        print(line)


def _value_lines(schema: Any, values: dict[str, Any], indent: str) -> list[str]:
    lines = []
    for f in schema.FIELDS:
        value = values[f.name]
        if f.nested is not None:
            for k, item in enumerate(value if f.count > 1 else [value]):
                lines.append(f"{indent}  {f.name}{f'[{k}]' if f.count > 1 else ''}:")
                lines += _value_lines(f.nested, item, indent + "  ")
            continue
        unit = f" [{_one_line(f.unit)}]" if f.unit else ""
        doc = f"    {_one_line(f.doc)}" if f.doc else ""
        lines.append(f"{indent}  {f.name}{unit} = {_text(value)}{doc}")
    return lines


def _one_line(text: str) -> str:
    """Text of a block's writer without line breaks and control characters."""
    return escaped(text).replace("\n", r"\n").replace("\t", r"\t")


def _text(value: Any) -> str:
    if isinstance(value, list):
        shown = ", ".join(_text(v) for v in value[:16])
        return f"[{shown}{f', ... {len(value)} in all' if len(value) > 16 else ''}]"
    if isinstance(value, float):
        return numbers_text(value, digits=9)
    return repr(value) if isinstance(value, str) else str(value)


def _every_option(default: float, text: str) -> Callable[[Any], Any]:
    """Option --every of commands that look at blocks again and again."""
    return click.option("--every", type=Finite(min=0.0), default=default, show_default=True, help=text)


@blocks_group.command("watch")
@click.argument("block")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
@_every_option(0.1, "Seconds between looks at the block.")
@click.option(
    "--count", type=click.IntRange(0), default=0, help="End after that many publications [0: go on]."
)
@click.option("--seconds", type=Finite(min=0.0), default=0.0, help="End after that time [0: go on].")
def watch_command(block: str, as_json: bool, every: float, count: int, seconds: float) -> None:
    """Print BLOCK's values whenever they changed, until Ctrl-C; follows its writer through restarts."""
    from surffollow.blocks.listing import attach_unknown
    from surffollow.cli.progress import stop_event
    from surffollow.config.trusted_users import trusted_owners
    from surffollow.errors import UsageError

    if every < WATCH_POLL_S:
        raise UsageError(f"--every must be at least {WATCH_POLL_S:g} s, not {every:g}")
    stop = stop_event()
    attached = attach_unknown(block, trusted_owners())
    deadline = time.monotonic() + seconds if seconds > 0 else None
    try:
        _watch(attached, as_json, every, count, deadline, stop)
    finally:
        attached.close()


def _watch(
    attached: AttachedBlock,
    as_json: bool,
    every: float,
    count: int,
    deadline: float | None,
    stop: threading.Event,
) -> None:
    last, printed = (-1, -1), 0
    while not stop.is_set() and (deadline is None or time.monotonic() < deadline):
        snapshot = attached.latest()
        this = (snapshot.epoch, snapshot.generation)
        if this != last and snapshot.generation:
            last, printed = this, printed + 1
            values = snapshot.values.as_dict()
            if as_json:
                line = {"generation": this[1], "epoch": this[0], "t_ns": snapshot.t_ns, "values": values}
                print(json.dumps(without_nan(line)), flush=True)
            else:
                text = ", ".join(f"{k}={_flat(v)}" for k, v in values.items())
                print(f"{this[1]:>8}  {text}", flush=True)
        if count and printed >= count:
            break
        stop.wait(every)


def _flat(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}={_flat(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[" + ", ".join(_flat(v) for v in value[:4]) + "]"
    return _text(value)


@blocks_group.command("record")
@click.argument("blocks", nargs=-1, required=True, metavar="BLOCK...")
@click.option("--out", type=OutputFile(), required=True, help="MCAP file to write.")
@_every_option(0.005, "Seconds between looks; what is published in between is missed, and counted.")
@click.option("--seconds", type=Finite(min=0.0), default=None, help="Stop after this long.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print the counts as JSON.")
def record_command(
    blocks: tuple[str, ...], out: str, every: float, seconds: float | None, force: bool, as_json: bool
) -> None:
    """Record every publication of BLOCKs (NAME.BLOCK) into an MCAP file, until Ctrl-C or --seconds.

    Viewers such as Foxglove plot it; `surffollow convert FILE --to csv` makes tables of it.
    """
    from surffollow.cli.progress import stop_event
    from surffollow.errors import UsageError
    from surffollow.record.block_file import record_blocks

    if every < WATCH_POLL_S:
        raise UsageError(f"--every must be at least {WATCH_POLL_S:g} s, not {every:g}")
    counts = record_blocks(blocks, out, stop_event(), every_s=every, seconds=seconds, force=force)
    if as_json:
        print(json.dumps({"file": out, "publications": counts.publications, "missed": counts.missed}))
        return
    for name, n in counts.publications.items():
        print(f"{out}: {n} publications of {name}, {counts.missed[name]} missed")


@blocks_group.command("rm")
@click.argument("blocks", nargs=-1, required=True, metavar="BLOCK...")
@JSON
def remove_command(blocks: tuple[str, ...], as_json: bool) -> None:
    """Remove BLOCKs (NAME.BLOCK) of writers that were killed; one whose writer lives is refused."""
    from surffollow.blocks.remove import remove_block

    for name in blocks:
        remove_block(name)
    if as_json:
        print(json.dumps({"removed": list(blocks)}))


@blocks_group.command("print-header")
@click.argument("block")
def print_header_command(block: str) -> None:
    """Print a C header for BLOCK's structure and a reader that never waits (needs surffollow.h)."""
    from surffollow.blocks.cheader import c_header
    from surffollow.blocks.listing import attach_unknown
    from surffollow.config.trusted_users import trusted_owners

    attached = attach_unknown(block, trusted_owners())
    try:
        print(c_header(attached.schema), end="")
    finally:
        attached.close()


old_name(blocks_group, print_header_command, "header")
