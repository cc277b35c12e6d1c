"""User blocks in recordings: written as they are published, read back as tables."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surffollow.blocks import AttachedBlock
from surffollow.blocks.layout import schema_from_text, schema_text
from surffollow.blocks.listing import attach_unknown
from surffollow.config.names import check_name
from surffollow.errors import InvalidNameError, RecordingError, SchemaError, UsageError
from surffollow.record import foxglove as fx
from surffollow.record.mcap_reader import CHANNEL, MESSAGE, MESSAGE_HEAD, Damage, McapReader
from surffollow.record.mcap_records import read_channel
from surffollow.record.protobuf import Field, Message
from surffollow.record.protobuf_types import message_of
from surffollow.record.writer import MessageWriter
from surffollow.shm.schema import Schema

PACKAGE = "surffollow.blocks"
DECLARATION = "surffollow.block"
# before a block's own fields; a block's field of the same name takes the place
_BEFORE = (
    Field("timestamp", 1, "message", of=fx.TIMESTAMP),
    Field("block_t_ns", 2, "sfixed64"),
    Field("block_generation", 3, "fixed64"),
    Field("block_epoch", 4, "fixed64"),
)


def block_message(schema: type[Schema]) -> Message:
    """The message type of a block: its fields behind the time and number of publication."""
    return message_of(schema, PACKAGE, _BEFORE)


@dataclass
class BlockCounts:
    """Counts of a recording; `missed` publications were replaced between two looks."""

    publications: dict[str, int] = field(default_factory=dict)
    missed: dict[str, int] = field(default_factory=dict)


class _Followed:
    """One block that is recorded."""

    def __init__(self, name: str) -> None:
        self.block: AttachedBlock = attach_unknown(name)
        self.name = name
        self.kind = block_message(self.block.schema)
        self.last = (-1, -1)

    def look(self, writer: MessageWriter, counts: BlockCounts) -> None:
        snapshot = self.block.latest()
        this = (int(snapshot.epoch), int(snapshot.generation))
        if this == self.last or not snapshot.generation:
            return
        if self.last[1] >= 0:
            counts.missed[self.name] += max(0, this[1] - self.last[1] - 1)
        self.last = this
        t_ns = int(snapshot.t_ns)
        values = {
            "timestamp": fx.stamp(t_ns + writer.wall_offset_ns),
            "block_t_ns": t_ns,
            "block_generation": this[1],
            "block_epoch": this[0],
            **snapshot.values.as_dict(),
        }
        writer.add_message(f"/blocks/{self.name}", self.kind, t_ns, self.kind.encode(values))
        counts.publications[self.name] += 1


def record_blocks(
    names: Sequence[str],
    out: str | Path,
    stop: threading.Event,
    *,
    every_s: float = 0.005,
    seconds: float | None = None,
    force: bool = False,
) -> BlockCounts:
    """Write every publication of blocks that is seen into an MCAP file, until `stop` or for `seconds`.

    Publications that came and went between two looks are counted as missed.

    Parameters
    ----------
    names : sequence of str  blocks
    out : path               MCAP file
    stop : threading.Event   set: the recording ends
    every_s : float [s]      time between two looks at the blocks
    seconds : float [s]      length of the recording; None: until `stop`
    force : bool             replace a file that is there

    Raises
    ------
    NotRunningError, BlockError   a block is not there, or is none
    UsageError                    a block is named twice
    FaultError                    the file exists or cannot be written
    """
    if len(set(names)) < len(names):
        raise UsageError("a block is named twice")
    followed: list[_Followed] = []
    try:
        for name in names:
            followed.append(_Followed(name))
        counts = BlockCounts(dict.fromkeys(names, 0), dict.fromkeys(names, 0))
        with MessageWriter(out, force=force) as writer:
            for f in followed:
                declaration = {DECLARATION: schema_text(f.block.schema)}
                writer.declare(f"/blocks/{f.name}", f.kind, declaration)
            end = None if seconds is None else time.monotonic() + seconds
            while not stop.is_set() and (end is None or time.monotonic() < end):
                for f in followed:
                    f.look(writer, counts)
                stop.wait(every_s)
            for f in followed:
                f.look(writer, counts)
            writer.finish(
                {"publications": json.dumps(counts.publications), "missed": json.dumps(counts.missed)}
            )
        return counts
    finally:
        for f in followed:
            f.block.close()


class BlockFile(McapReader):
    """A recording of blocks."""

    @classmethod
    def opened(cls, path: str | Path) -> BlockFile | None:
        """The file, when blocks are declared in it; None: it is another kind of MCAP file.

        Raises
        ------
        RecordingError  no MCAP file
        """
        reader = cls(path)
        found = Damage(list(reader.damage.reasons))
        for opcode, body in reader.records():
            if opcode == CHANNEL:
                if DECLARATION in read_channel(body)[4]:
                    # damage met in this look will be met and counted again
                    reader.damage = found
                    return reader
                break
            if opcode == MESSAGE:
                break
        reader.close()
        return None

    def tables(self) -> dict[str, dict[str, list[Any]]]:
        """Per block a table: column → values in the order of publication.

        Raises
        ------
        RecordingError  no publication in it, or a declaration that is none
        """
        kinds: dict[int, tuple[str, Message, type[Schema]]] = {}
        declared: dict[str, int] = {}
        rows: dict[str, list[list[Any]]] = {}
        for opcode, body in self.records():
            if opcode == CHANNEL:
                number, _, topic, _, about = read_channel(body)
                if DECLARATION in about and number not in kinds:
                    try:
                        schema = schema_from_text(about[DECLARATION])
                    except SchemaError as e:
                        raise RecordingError(f"{self.path}: {e}") from None
                    name = self._block_name(topic)
                    if declared.setdefault(name, schema.HASH) != schema.HASH:
                        raise RecordingError(f"{self.path} declares the block {name} in two ways")
                    kinds[number] = name, block_message(schema), schema
            elif opcode == MESSAGE:
                number = int.from_bytes(body[:2], "little")
                if number in kinds:
                    name, kind, schema = kinds[number]
                    try:
                        row = _row(schema, kind.decode(bytes(body[MESSAGE_HEAD.size :])))
                    except ValueError as e:
                        self.damage.add(f"a publication of {name} cannot be read: {e}", lost_bytes=len(body))
                        continue
                    rows.setdefault(name, []).append(row)
        if not rows:
            why = f" ({self.damage})" if self.damage else ""
            raise RecordingError(f"{self.path} holds no publication of a block{why}")
        # not before: a declaration may have more columns than the memory has room for
        columns = {name: _columns(schema) for name, _, schema in kinds.values() if name in rows}
        return {name: dict(zip(columns[name], map(list, zip(*found)))) for name, found in rows.items()}

    def _block_name(self, topic: str) -> str:
        """The block that a topic names; it becomes a part of a file's name."""
        name = topic.removeprefix("/blocks/")
        try:
            check_name(name)
        except InvalidNameError as e:
            raise RecordingError(f"{self.path} holds a block whose {e}") from None
        return name


def _columns(schema: type[Schema]) -> list[str]:
    """Names of a table's columns: the publication's time and number, then every leaf of the block.

    A leaf is named without punctuation, such as `axes0`, `parts1_value`. One whose name another column has
    is named by its exact place instead: `axes[0]`, `parts[1].value`.
    """
    before = [f.name for f in _BEFORE[1:]]
    leaves = list(_leaf_names(schema, "", ""))
    times = Counter(plain for plain, _ in leaves)
    names = [exact if times[plain] > 1 or plain in before else plain for plain, exact in leaves]
    own = {f.name for f in schema.FIELDS}
    return [*(n for n in before if n not in own), *names]


def _leaf_names(schema: type[Schema], plain: str, exact: str) -> Iterator[tuple[str, str]]:
    for f in schema.FIELDS:
        array = f.count > 1 and not f.is_text
        for k in range(f.count if array else 1):
            names = f"{plain}{f.name}{k if array else ''}", f"{exact}{f.name}{f'[{k}]' if array else ''}"
            if f.nested is not None:
                yield from _leaf_names(f.nested, f"{names[0]}_", f"{names[1]}.")
            else:
                yield names


def _row(schema: type[Schema], values: dict[str, Any]) -> list[Any]:
    """Values of the columns.

    Raises
    ------
    ValueError  an array has not the declared number of items
    """
    own = {f.name for f in schema.FIELDS}
    return [*(values.get(f.name, 0) for f in _BEFORE[1:] if f.name not in own), *_leaves(schema, values)]


def _leaves(schema: type[Schema], values: dict[str, Any]) -> Iterator[Any]:
    for f in schema.FIELDS:
        value: Any = values.get(f.name)
        is_array = f.count > 1 and not f.is_text
        if is_array and len(value or ()) != f.count:
            raise ValueError(f"{f.name} has {len(value or ())} items; {f.count} are declared")
        if f.nested is not None:
            for item in value if is_array else [value or {}]:
                yield from _leaves(f.nested, item)
        elif f.is_text:
            yield value or ""
        elif is_array:
            yield from value
        else:
            yield value if value is not None else 0
