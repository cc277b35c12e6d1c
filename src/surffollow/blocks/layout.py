"""The object of one user block: a header page, the schema as text, a latch over head and payload.

Everything in it is written by the block's writer alone; readers map it read-only and
speak through the kernel's locks (`locks`). The name, hash and text let a program that
has never seen the schema show the values (`surffollow blocks show`).
"""

from __future__ import annotations

import json
from typing import Any

from surffollow.errors import BlockError, LayoutMismatchError, SchemaError
from surffollow.shm.latch_shape import HEAD_BYTES, latch_bytes, stride
from surffollow.shm.objects import SharedObject
from surffollow.shm.schema import I64, SCALARS, U64, Field, Schema, Text

BLOCK_MAGIC = int.from_bytes(b"SURFBLK1", "little")
BLOCK_VERSION = 1
PAGE = 4096
STATE_LIVE, STATE_GONE = 1, 2
_MAX_TEXT = 1 << 20
# beyond 64 bytes a slot's payload would not be where its alignment wants it
MAX_ALIGN = 64


class BlockHeader(Schema):
    """Identity of a block and of its writer; magic is stored last."""

    magic = U64()
    version = U64()
    schema_hash = U64()
    payload_bytes = U64(unit="B")
    text_bytes = U64(unit="B", doc="length of the schema's JSON text, from byte 4096 on")
    latch_offset = U64(unit="B")
    size = U64(unit="B")
    lease_ns = U64(
        unit="ns", doc="a reader that holds the writer up for longer is fenced; 0: it waits for none"
    )
    epoch = U64(doc="number of the writer: one more for every writer that takes over")
    writer_pid = I64()
    writer_start_ticks = I64()
    name = Text(64)
    schema_name = Text(64)
    state = U64(align=64, doc="1: live, 2: this object was given up, look for the name again")
    waiting_ns = U64(align=64, unit="ns", doc="since when the writer waits for readers; 0: it does not")
    fence = U64(
        align=64,
        doc="names the byte that is locked; how many times readers were fenced, with lease_ns 0 each write",
    )


class SlotHead(Schema):
    """Header of the payload in every slot of the latch."""

    generation = U64()
    epoch = U64()
    t_ns = I64(unit="ns", doc="when it was published, CLOCK_MONOTONIC")
    reserved = U64(5)


HEAD = SlotHead.SIZE
STATE_WORD = BlockHeader.offset("state") // 8
WAITING_WORD = BlockHeader.offset("waiting_ns") // 8
FENCE_WORD = BlockHeader.offset("fence") // 8
LEASE_WORD = BlockHeader.offset("lease_ns") // 8
EPOCH_WORD = BlockHeader.offset("epoch") // 8


def schema_text(schema: type[Schema]) -> str:
    """A schema as JSON: names, types, counts, units, meanings."""
    return json.dumps(_to_plain(schema), ensure_ascii=False, separators=(",", ":"))


def _to_plain(schema: type[Schema]) -> dict[str, Any]:
    fields = []
    for f in schema.FIELDS:
        plain: dict[str, Any] = {"name": f.name, "type": f.code, "count": f.count}
        plain |= {k: v for k, v in (("unit", f.unit), ("doc", f.doc), ("align", f.extra_align)) if v}
        if f.nested is not None:
            plain["of"] = _to_plain(f.nested)
        fields.append(plain)
    return {"schema": schema.__name__, "doc": (schema.__doc__ or "").strip(), "fields": fields}


def schema_from_text(text: str) -> type[Schema]:
    """The schema that a text from `schema_text` declares.

    Raises
    ------
    SchemaError  the text is none, or makes no layout
    """
    try:
        return _from_plain(json.loads(text), 0)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as e:
        raise SchemaError(f"the text declares no schema: {e!r}") from None


def _from_plain(plain: dict[str, Any], depth: int) -> type[Schema]:
    if depth > 16:
        raise SchemaError("schemas are nested more than 16 deep")
    members: dict[str, Any] = {"__doc__": str(plain.get("doc", ""))}
    for f in plain["fields"]:
        nested = _from_plain(f["of"], depth + 1) if "of" in f else None
        if nested is None and f["type"] != "S" and f["type"] not in SCALARS:
            raise SchemaError(f"unknown field type {f['type']!r}")
        members[f["name"]] = Field(
            f["type"],
            f["count"],
            unit=f.get("unit", ""),
            doc=f.get("doc", ""),
            nested=nested,
            align=f.get("align", 0),
        )
    return type(str(plain["schema"]), (Schema,), members)


def sizes(schema: type[Schema]) -> tuple[int, int, int]:
    """Bytes of the schema's text, offset of the latch, size of the whole object."""
    if schema.ALIGN > MAX_ALIGN:
        raise SchemaError(
            f"block {schema.__name__} wants {schema.ALIGN}-byte alignment; {MAX_ALIGN} is the most"
        )
    text = len(schema_text(schema).encode())
    if text > _MAX_TEXT:
        raise SchemaError(
            f"the declaration of {schema.__name__} takes {text} bytes; {_MAX_TEXT} are the most"
        )
    latch = PAGE + -(-text // PAGE) * PAGE
    return text, latch, latch + -(-latch_bytes(HEAD + schema.SIZE) // PAGE) * PAGE


def slot_places(schema: type[Schema], latch_offset: int) -> tuple[int, int, int]:
    """Index of the generation word, offset of slot 0, bytes from slot to slot."""
    return latch_offset // 8, latch_offset + HEAD_BYTES, stride(HEAD + schema.SIZE)


def read_header(memory: Any) -> dict[str, Any]:
    """The header's fields; the object is known to be as large as that."""
    from surffollow.client.latch_reader import unpack_schema

    return unpack_schema(BlockHeader, memory)


def is_block(obj: SharedObject) -> bool:
    """Whether the object begins like a block of this version."""
    if obj.size < PAGE + HEAD_BYTES:
        return False
    h = read_header(obj.memory)
    return bool(h["magic"] == BLOCK_MAGIC and h["version"] == BLOCK_VERSION)


def check_block(obj: SharedObject, schema: type[Schema]) -> None:
    """Make sure that the object is a block of this schema.

    Raises
    ------
    BlockError           it is no block, or shorter than it says
    LayoutMismatchError  it was declared otherwise
    """
    if not is_block(obj):
        raise BlockError(f"shared-memory object {obj.name!r} is not a block of version {BLOCK_VERSION}")
    h = read_header(obj.memory)
    if h["schema_hash"] != schema.HASH:
        raise LayoutMismatchError(
            f"block {obj.name!r} is laid out as {h['schema_name']} {h['schema_hash']:016x}, this program "
            f"expects {schema.__name__} {schema.HASH:016x}; restart the older of the two "
            f"(surffollow blocks show {obj.name})"
        )
    _, latch, size = sizes(schema)
    # docs are outside the hash, so the text's length and the latch's place may differ from ours
    latch = h["latch_offset"]
    whole = latch + latch_bytes(HEAD + schema.SIZE)
    if latch % 64 or latch < PAGE or whole > obj.size or h["payload_bytes"] != schema.SIZE:
        raise BlockError(f"block {obj.name!r} is damaged: {size} bytes are needed, {obj.size} are there")


def declared_schema(obj: SharedObject) -> type[Schema]:
    """The schema that a block carries with it.

    Raises
    ------
    BlockError  it is no block, or its text and its hash disagree
    """
    if not is_block(obj):
        raise BlockError(f"shared-memory object {obj.name!r} is not a block of version {BLOCK_VERSION}")
    h = read_header(obj.memory)
    end = PAGE + min(h["text_bytes"], _MAX_TEXT)
    text = bytes(obj.memory[PAGE:end]).decode("utf-8", "replace")
    try:
        schema = schema_from_text(text)
    except SchemaError as e:
        raise BlockError(f"block {obj.name!r} carries no readable schema: {e}") from None
    check_block(obj, schema)
    return schema
