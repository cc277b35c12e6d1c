"""Write the tables of docs/reference/layout.md from the layout's declaration; `--check` only compares."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from surffollow.shm import board_regions
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm import map_layout as ml
from surffollow.shm.cheader import SCHEMAS, c_name
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, latch_bytes, stride
from surffollow.shm.layout_follow import Output
from surffollow.shm.layout_json import part_shape
from surffollow.shm.schema import SCALARS, Field, Schema

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "layout.md"
BEGIN, END = "<!-- bytes: written by tools/protocol_tables.py -->\n", "<!-- end of bytes -->"


def c_type(f: Field) -> str:
    """A field's type as C spells it."""
    if f.nested is not None:
        kind = c_name(f.nested)
    else:
        kind = "char" if f.is_text else SCALARS[f.code][2]
    return f"{kind}[{f.count}]" if f.count > 1 or f.is_text else kind


def schema_table(schema: type[Schema]) -> Iterator[str]:
    """One structure: offset, type, name, unit, meaning."""
    doc = (schema.__doc__ or "").strip().splitlines()[0]
    yield f"#### `{c_name(schema)}`, {schema.SIZE} bytes\n\n{doc}\n"
    yield "| offset | bytes | type | field | unit | meaning |\n| ---: | ---: | --- | --- | --- | --- |"
    for f in schema.FIELDS:
        unit = "" if f.unit in ("", "1") else f.unit
        yield f"| {f.offset} | {f.size} | {c_type(f)} | `{f.name}` | {unit} | {f.doc} |"
    yield ""


def objects_table() -> Iterator[str]:
    """Where the parts of the three objects lie."""
    yield "### Parts of the objects\n"
    yield "Board (offsets are in its region table; these are those of the default `log_words` = 2^20):\n"
    yield "| offset | bytes | part | holds |\n| ---: | ---: | --- | --- |"
    yield f"| 0 | {lb.BoardHeader.SIZE} | header | `{c_name(lb.BoardHeader)}` |"
    schemas = {name: schema for name, schema, _ in board_regions.BOARD_PARTS}
    shapes = {name: part_shape(schema, bytes_) for name, schema, bytes_ in board_regions.BOARD_PARTS}
    for name, (offset, size) in board_regions.board_regions(1 << 20).items():
        kind, count = shapes[name]
        n = f"{count} {kind}es" if count > 1 else kind
        words = ", then the log's words" if name == "log" else ""
        yield f"| {offset} | {size} | {name} | {n}, `{c_name(schemas[name])}`{words} |"
    slot: tuple[tuple[int, type[Schema], bool], ...] = (
        (ls.SLOT_HEAD, ls.SlotHead, False),
        (ls.SLOT_POSE, ls.PosePost, True),
        (ls.SLOT_REQUEST, ls.RequestPost, True),
    )
    yield f"\nA slot, {ls.SLOT_BYTES} bytes:\n"
    yield "| offset | bytes | holds |\n| ---: | ---: | --- |"
    for offset, schema, is_latch in slot:
        size = latch_bytes(schema.SIZE) if is_latch else schema.SIZE
        yield f"| {offset} | {size} | {'latch, ' if is_latch else ''}`{c_name(schema)}` |"
    size = ls.RANGES_AT + ls.RANGE_ITEMS * ls.RangeItem.SIZE
    yield (
        f"| {ls.SLOT_RANGES} | {size} | ring: int64 items pushed so far; from byte {ls.RANGES_AT} on "
        f"{ls.RANGE_ITEMS} `{c_name(ls.RangeItem)}` |"
    )
    for k in range(2):
        offset = ls.SLOT_STREAM + k * ls.PIECE_BYTES
        yield f"| {offset} | {ls.PIECE_BYTES} | `{c_name(ls.StreamPiece)}` and {ls.PIECE_GRIDS} grids |"
    yield "\nMap:\n"
    yield "| offset | bytes | holds |\n| ---: | ---: | --- |"
    yield f"| 0 | {ml.MapHeader.SIZE} | `{c_name(ml.MapHeader)}` |"
    yield f"| {ml.HEADER_BYTES} | {ml.PAIR_BYTES} per pair | `{c_name(ml.GridPair)}`, grid i in pair i / 2 |"
    yield "| page after the pairs | `scratch_bytes` | the service's own |\n"


def latch_table() -> Iterator[str]:
    """A latch in bytes, with the output as the example."""
    yield "### A latch\n"
    yield "| offset | bytes | holds |\n| ---: | ---: | --- |"
    yield "| 0 | 8 | generation g, int64; 0: nothing published yet |"
    yield f"| 8 | {HEAD_BYTES - 8} | nothing: the generation has a cache line of its own |"
    for k in range(SLOTS):
        yield f"| {HEAD_BYTES} + {k}·stride | payload | copies with g mod {SLOTS} = {k} |"
    step = stride(Output.SIZE)
    yield f"\nThe stride is the payload's size, rounded up to 64 bytes; that of `sf_output` is {step}.\n"


def code_table() -> Iterator[str]:
    """Requests and answers by number."""
    yield "### Requests and answers\n"
    yield "| code | request |\n| ---: | --- |"
    yield from (f"| {v} | {n[3:]} |" for n, v in lb.codes("RQ_").items())
    yield "\n| answer | meaning |\n| ---: | --- |"
    yield from (f"| {v} | {text} |" for v, text in enumerate(lb.RESULT_TEXT))
    yield "\n| step on NAME.sock | message |\n| ---: | --- |"
    steps = ("SLOT_ASK", "SLOT_OFFER", "SLOT_MAPPED", "SLOT_GRANT", "SLOT_REFUSE")
    yield from (f"| {getattr(ls, n)} | {n} |" for n in steps)
    yield "\n| result of SLOT_REFUSE | meaning |\n| ---: | --- |"
    yield from (f"| {v} | {text} |" for v, text in enumerate(ls.SLOT_TEXT) if v)
    yield ""


def tables() -> str:
    """All tables, in the order in which a reader needs them."""
    lines = [*objects_table(), *latch_table(), *code_table(), "### Structures\n"]
    for schema in SCHEMAS:
        lines.extend(schema_table(schema))
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page as it should be."""
    text = PAGE.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN, 1)
    return head + BEGIN + "\n" + tables() + END + rest.split(END, 1)[1]


if __name__ == "__main__":
    expected = page()
    if "--check" in sys.argv[1:]:
        same = expected == PAGE.read_text(encoding="utf-8")
        sys.exit(0 if same else f"docs/reference/{PAGE.name} is out of date")
    PAGE.write_text(expected, encoding="utf-8")
