"""C for user blocks: fragments with the layout of a block filled in, and the constants of a schema."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from surffollow.blocks import layout as bl
from surffollow.shm.locks import FENCE_BASE, QUEUE_BYTE
from surffollow.shm.schema import Schema

PARTS = Path(__file__).with_name("header")


def part(name: str) -> str:
    """C text of a fragment in `header/`."""
    return (PARTS / name).read_text(encoding="utf-8")


def with_layout(text: str, more: Mapping[str, object]) -> str:
    """Replace `{name}` in C text by places and constants of a block's layout.

    Parameters
    ----------
    text : str
        C text
    more : mapping
        names beyond those that reader and writer share, and their values

    Returns
    -------
    str
        C text without such names
    """
    at = bl.BlockHeader.offset
    values = {
        "head_bytes": bl.PAGE,
        "latch_offset": at("latch_offset"),
        "slot_head": bl.HEAD,
        "magic": bl.BLOCK_MAGIC,
        "version_at": at("version"),
        "version": bl.BLOCK_VERSION,
        "hash_at": at("schema_hash"),
        "state_at": at("state"),
        "live": bl.STATE_LIVE,
        "t_at": bl.SlotHead.offset("t_ns"),
        **more,
    }
    for name, value in values.items():
        text = text.replace("{" + name + "}", str(value))
    return text


def writer_text() -> str:
    """C text of the writer and of waiting reads of any block; stands behind the reader's."""
    at = bl.BlockHeader.offset
    values = {
        "payload_at": at("payload_bytes"),
        "text_at": at("text_bytes"),
        "pid_at": at("writer_pid"),
        "ticks_at": at("writer_start_ticks"),
        "lease_at": at("lease_ns"),
        "gone": bl.STATE_GONE,
        "fence_base": f"INT64_C({FENCE_BASE})",
        "queue_byte": QUEUE_BYTE,
    }
    for name in ("size", "epoch", "name", "schema_name", "waiting", "fence"):
        values[f"{name}_at"] = at({"waiting": "waiting_ns"}.get(name, name))
    return with_layout(part("20_writer.h") + part("30_waiting.h"), values)


def schema_constant(schema: type[Schema], name: str) -> str:
    """C text: what a writer must know of a schema, as `NAME_schema()`."""
    text = bl.schema_text(schema).encode()
    rows = [", ".join(str(b) for b in text[k : k + 24]) for k in range(0, len(text), 24)]
    body = ",\n    ".join(rows)
    return (
        f"\n/* For a writer of {schema.__name__}: sfb_start_writing(&w, name, {name}_schema(), ...). */\n"
        f"static inline const sfb_schema *{name}_schema(void) {{\n"
        f"  static const unsigned char text[{len(text)}] = {{\n    {body}}};\n"
        f"  static const sfb_schema schema = {{UINT64_C({schema.HASH}), {schema.SIZE}, {len(text)}, "
        f'"{schema.__name__}", text}};\n  return &schema;\n}}\n'
    )
