"""User blocks in recordings: every publication seen, decoded by a public reader and as a table."""

from __future__ import annotations

import json
import os
import re
import threading
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from surffollow.blocks import F32, F64, I64, U8, Block, Nested, Text, mem_attach
from surffollow.errors import RecordingError, UsageError
from surffollow.record.block_file import DECLARATION, record_blocks
from surffollow.record.convert import convert
from surffollow.record.recover import recover
from surffollow.shm.schema import Schema


class Axis(Schema):
    """One axis."""

    value = F64(unit="m")
    home = U8()


class Stamp(Schema):
    """A time."""

    t_ns = I64()


class Joystick(Block):
    """All kinds of fields."""

    deadman = I64()
    axes = F64(3, unit="m/s")
    gain = F32()
    name = Text(8)
    parts = Nested(Axis, 2)


def test_publications_are_read_back_by_a_public_reader_and_as_a_table(tmp_path: Path) -> None:
    path, cell = tmp_path / "blocks.mcap", f"rec{os.getpid()}"
    with mem_attach(Joystick, cell, write=True) as mem:

        def publish(k: int) -> None:
            with mem.joystick.write() as slot:
                slot.deadman, slot.axes, slot.gain = -k, [0.5 * k, 1.0, 2.0], 0.25
                slot.name = f"n{k}"
                slot.parts[1].value = 7.0 + k

        publish(0)

        class Stop(threading.Event):
            """Publishes between two looks, in the recorder's own pace."""

            n = 0

            def wait(self, timeout: float | None = None) -> bool:
                self.n += 1
                if self.n < 10:
                    publish(self.n)
                else:
                    self.set()
                return self.is_set()

        counts = record_blocks([f"{cell}.joystick"], path, Stop(), every_s=0.001)
    assert counts.publications == {f"{cell}.joystick": 10}
    assert counts.missed == {f"{cell}.joystick": 0}
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [m for *_, m in reader.iter_decoded_messages()]
    assert [m.deadman for m in messages] == [-k for k in range(10)]
    assert list(messages[3].axes) == [1.5, 1.0, 2.0]
    assert (messages[3].name, messages[3].gain, messages[3].parts[1].value) == ("n3", 0.25, 10.0)
    done = convert([path], "csv")
    [table] = done.files
    rows = [line.split(",") for line in Path(table).read_text().splitlines()]
    row = dict(zip(rows[0], rows[4]))
    assert (row["deadman"], row["axes0"], row["name"], row["parts1_value"]) == ("-3", "1.5", "n3", "10.0")
    assert done.rows == 10


class Colliding(Block):
    """Columns of one name: q[0] and q0, part.value and part_value, when.t_ns and the publication's time."""

    q = F64(2)
    q0 = F64()
    part = Nested(Axis)
    part_value = F64()
    block = Nested(Stamp)


def test_columns_of_one_name_get_names_of_their_own(tmp_path: Path) -> None:
    path, cell = tmp_path / "blocks.mcap", f"col{os.getpid()}"
    with mem_attach(Colliding, cell, write=True) as mem:
        with mem.colliding.write() as slot:
            slot.q, slot.q0, slot.part.value, slot.part_value, slot.block.t_ns = [1.0, 2.0], 3.0, 4.0, 5.0, 6
        stop = threading.Event()
        stop.set()
        record_blocks([f"{cell}.colliding"], path, stop)
    [table] = convert([path], "csv").files
    names, values = (line.split(",") for line in Path(table).read_text().splitlines())
    row = dict(zip(names, values))
    assert len(row) == len(names) == len(values)
    found = {n: row[n] for n in ("q[0]", "q1", "q0", "part.value", "part_home", "part_value", "block.t_ns")}
    assert list(found.values()) == ["1.0", "2.0", "3.0", "4.0", "0", "5.0", "6"]
    assert int(row["block_t_ns"]) > 1_000_000


def test_a_cut_recording_of_blocks_is_recovered(tmp_path: Path) -> None:
    path, cell = tmp_path / "blocks.mcap", f"cut{os.getpid()}"
    with mem_attach(Joystick, cell, write=True) as mem:
        with mem.joystick.write() as slot:
            slot.deadman = 1
        stop = threading.Event()
        stop.set()
        record_blocks([f"{cell}.joystick"], path, stop)
    data = path.read_bytes()
    path.write_bytes(data[:-40])  # its footer
    done = recover(path)
    assert (done.messages, done.cycles) == (1, 0)
    assert convert([done.file], "csv").rows == 1


ONE = {"name": "v", "type": "f8", "count": 1}


def declared(*fields: dict[str, Any]) -> str:
    """The text of a declaration."""
    return json.dumps({"schema": "A", "fields": list(fields)})


def nested(levels: int) -> dict[str, Any]:
    """A field of 5 ** levels numbers."""
    of = {"schema": "A", "fields": [nested(levels - 1)]} if levels else None
    return {"name": "v", "type": "x", "count": 5, "of": of} if of else ONE


def by_hand(path: Path, channels: list[tuple[str, str]], data: bytes = b"") -> Path:
    """A recording of blocks with one message in each channel (name, declaration)."""
    with open(path, "wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start("x", "x")
        schema = writer.register_schema("s", "protobuf", b"")
        for name, declaration in channels:
            about = {DECLARATION: declaration}
            channel = writer.register_channel(f"/blocks/{name}", "protobuf", schema, about)
            writer.add_message(channel, 0, data, 0)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("channels", "data", "says"),
    [
        ([("../../x", declared(ONE))], b"", "a block whose name '../../x' is not allowed"),
        ([("a\0b", declared(ONE))], b"", "is not allowed"),
        ([("x", "[" * 100_000)], b"", "declares no schema"),
        ([("x", declared(ONE))], b"\xff", "a publication of x cannot be read: a message is cut short"),
        ([("x", declared(ONE | {"count": 1 << 36}))], b"", "v has 0 items; 68719476736 are declared"),
        ([("x", declared(nested(15)))], b"", "v has 0 items; 5 are declared"),
        ([("x", declared(ONE)), ("x", declared(ONE | {"count": 2}))], b"", "the block x in two ways"),
    ],
)
def test_a_crafted_recording_of_blocks_is_refused(
    tmp_path: Path, channels: list[tuple[str, str]], data: bytes, says: str
) -> None:
    path = by_hand(tmp_path / "blocks.mcap", channels, data)
    with pytest.raises(RecordingError, match=re.escape(says)):
        convert([path], "csv")
    assert [p.name for p in tmp_path.iterdir()] == ["blocks.mcap"]


def test_a_block_named_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="twice"):
        record_blocks(["a.b", "a.b"], tmp_path / "x.mcap", threading.Event())
