"""The standard channels: public readers decode them, and they equal what the follower published."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from surffollow.record import foxglove as fx
from surffollow.record.channel_feed import ChannelFeed
from surffollow.record.channels import StandardChannels, add_demand, plain
from surffollow.record.convert import convert
from surffollow.record.protobuf import Message
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.replay import replay_file
from surffollow.record.samples import Event
from surffollow.record.synthetic_log import SyntheticLog
from surffollow.record.table import Table
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_board import RQ_MAP_RESET
from surffollow.shm.layout_follow import STOPPED, VALID, Output, Params

Decoded = dict[str, list[tuple[Any, Any]]]


def decoded(path: Path) -> Decoded:
    """All messages of protocol buffers in a file by topic, as (MCAP message, decoded)."""
    found: Decoded = {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if schema is not None and schema.encoding == "protobuf":
                decode = DecoderFactory().decoder_for("protobuf", schema)
                assert decode is not None
                found.setdefault(channel.topic, []).append((message, decode(message.data)))
    return found


def record_synthetic_log(
    path: Path, cycles: int = 1000, rate_hz: float = 100.0, **options: int
) -> dict[int, dict[str, Any]]:
    """Record a synthetic log with channels; what each cycle published, by its number."""
    synthetic_log = SyntheticLog(**options)
    writer = RecordingWriter(path, {"name": "synthetic_log"}, force=True)
    feed = ChannelFeed(writer, round(1e9 / rate_hz))
    recorder = Recorder(synthetic_log, writer, feed)
    published = {}
    for _ in range(cycles):
        synthetic_log.run(1)
        published[int(synthetic_log.output[0]["cycle"])] = plain(Output, synthetic_log.output[0].copy())
        if len(published) % 50 == 0:
            recorder.poll()
            feed.work()
    recorder.finish()
    return published


@pytest.mark.parametrize("kind", fx.ALL, ids=lambda m: m.name)
def test_types_are_those_of_foxgloves_own_schemas(kind: Message) -> None:
    def compare(mine: Message) -> None:
        package = "google.protobuf.timestamp_pb2" if mine is fx.TIMESTAMP else ""
        module = importlib.import_module(package or f"foxglove_schemas_protobuf.{mine.name}_pb2")
        theirs = getattr(module, mine.name).DESCRIPTOR
        assert theirs.full_name == mine.full_name
        names = {f.name: (f.number, f.type, f.is_repeated) for f in theirs.fields}
        from surffollow.record.protobuf import KINDS

        assert {f.name: (f.number, KINDS[f.kind][0], f.repeated) for f in mine.fields} == names
        for f in mine.fields:
            if isinstance(f.of, Message):
                compare(f.of)
        enums = {e.name: [v.name for v in e.values] for e in theirs.enum_types}
        assert {e.name: list(e.values) for e in mine.enums} == enums

    compare(kind)


@pytest.mark.parametrize(("mode", "channels"), [(0, 1), (1, 3)])
def test_a_public_reader_decodes_what_every_cycle_published(tmp_path: Path, mode: int, channels: int) -> None:
    path = tmp_path / "run.mcap"
    published = record_synthetic_log(path, mode=mode, channels=channels)
    report = replay_file(path)
    assert report.identical, report
    assert report.cycles == len(published)
    found = decoded(path)
    states = found["/state"]
    assert len(states) == 100
    offset_ns = states[0][0].log_time - states[0][0].publish_time
    for message, state in states:
        expected = published[state.cycle]
        assert message.publish_time == state.t_ns == expected["t_ns"]
        assert message.log_time - message.publish_time == offset_ns
        assert state.timestamp.ToNanoseconds() == message.log_time
        for name, value in expected.items():
            got = getattr(state, name)
            if isinstance(value, list):
                many = list(got)
                np.testing.assert_array_equal(many, value[: len(many)], err_msg=name)
                assert len(many) == {
                    "range_m": channels,
                    "range_t_ns": channels,
                    "target_m": 3 * channels,
                }.get(name, len(value))
            elif name != "epoch":
                assert got == value or (math.isnan(got) and math.isnan(value)), name
    at_cycle = {state.t_ns: state for _, state in states}
    for message, pose in found["/setpoint"]:
        state = at_cycle[message.publish_time]
        assert state.status & VALID
        reported = next(p for m, p in found["/pose"] if m.publish_time == message.publish_time)
        assert pose.pose.position.z == reported.pose.position.z + state.demand[2]
    for message, scan in found["/beam/0"]:
        assert list(scan.ranges) == [at_cycle[message.publish_time].range_m[0]]
    points = sum(len(cloud.data) // cloud.point_stride for _, cloud in found["/points"])
    fresh = sum(bin(p["fresh"]).count("1") for p in published.values())
    assert fresh - 8 * channels * 10 < points <= fresh  # those after the last sample have none to go with
    assert found["/params"][0][1].offset_m == 0.1
    frames = {t.child_frame_id for _, tf in found["/tf"] for t in tf.transforms}
    assert frames == {"tool", *(f"sensor{c}" for c in range(channels))}


class Converted(NamedTuple):
    """A synthetic log and what its words alone were converted to."""

    live: Decoded
    again: Decoded
    published: dict[int, dict[str, Any]]
    differing: int


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Converted:
    folder = tmp_path_factory.mktemp("converted")
    path, again = folder / "run.mcap", folder / "again.mcap"
    published = record_synthetic_log(path)
    differing = convert([path], "foxglove", again).differing
    return Converted(decoded(path), decoded(again), published, differing)


def test_words_alone_give_the_same_channels_as_recording_them_did(converted: Converted) -> None:
    assert converted.differing == 0
    live, again = converted.live, converted.again
    assert set(again) - {"/map"} == set(live)
    for topic, messages in live.items():
        assert [m.data for m, _ in again[topic]] == [m.data for m, _ in messages], topic


def test_a_cloud_of_the_map_lies_where_the_target_points_were(converted: Converted) -> None:
    _, cloud = converted.again["/map"][-1]
    kinds = [(f.name, "u1" if f.type == 1 else "<f8") for f in cloud.fields]
    points = np.frombuffer(cloud.data, np.dtype(kinds))
    assert points.dtype.itemsize == cloud.point_stride
    targets = np.array([p["target_m"][:3] for p in converted.published.values() if p["fresh"] & 1])
    assert int(points["samples"].sum()) == len(targets)
    assert abs(points["x"].min() - targets[:, 0].min()) < 0.003
    np.testing.assert_allclose(
        np.average(points["z"], weights=points["samples"]), targets[:, 2].mean(), atol=1e-4
    )


def test_a_demand_is_added_and_turned_in_the_world() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(5)
    pose = [0.1, 0.2, 0.3, *Rotation.random(random_state=5).as_quat().tolist()]
    demand = rng.normal(0.0, 0.3, 6).tolist()
    moved = add_demand(pose, demand)
    expected = Rotation.from_rotvec(demand[3:]) * Rotation.from_quat(pose[3:])
    np.testing.assert_allclose(moved[:3], np.add(pose[:3], demand[:3]))
    np.testing.assert_allclose(Rotation.from_quat(moved[3:]).as_matrix(), expected.as_matrix(), atol=1e-12)


def read_table(path: Path) -> Table:
    if path.suffix == ".parquet":
        pq = importlib.import_module("pyarrow.parquet")
        return {k: np.array(v) for k, v in pq.read_table(path).to_pydict().items()}
    lines = path.read_text().splitlines()
    columns = zip(*(line.split(",") for line in lines[1:]))
    return {k: np.array(list(v)) for k, v in zip(lines[0].split(","), columns)}


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_a_table_holds_what_every_cycle_published(
    tmp_path: Path, make_recording: Callable[..., Path], to: str
) -> None:
    path = tmp_path / "run.mcap"
    published = record_synthetic_log(path, cycles=600, mode=1)
    done = convert([path], to, rate_hz=0)
    table = read_table(Path(done.files[0]))
    assert done.rows == done.cycles == len(table["cycle"]) == len(published)
    for k, cycle in enumerate(table["cycle"].tolist()):
        expected = published[int(cycle)]
        assert int(table["t_ns"][k]) == expected["t_ns"]
        assert float(table["demand_z_m"][k]) == expected["demand"][2]
        assert float(table["height_m"][k]) == expected["height_m"]
        cell = table["range0_m"][k]
        assert (cell in ("", None) or float(cell) != float(cell)) == math.isnan(expected["range_m"][0])


def test_of_a_cut_recording_the_table_holds_what_is_whole(tmp_path: Path, recording_bytes: bytes) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recording_bytes[: len(recording_bytes) * 2 // 3])
    done = convert([path], "csv", rate_hz=0)
    assert done.cycles == replay_file(path).cycles
    assert done.damage


def test_after_a_hole_stepping_goes_on_at_the_next_snapshot(tmp_path: Path, recording_bytes: bytes) -> None:
    hole = bytearray(recording_bytes)
    middle = len(hole) // 2
    hole[middle : middle + 64] = bytes(64)
    path = tmp_path / "hole.mcap"
    path.write_bytes(hole)
    done = convert([path], "csv", rate_hz=0)
    assert done.differing == 0
    assert done.damage
    assert 1000 <= done.rows < 3000


def test_a_stop_and_its_reset_end_neither_channels_nor_table(tmp_path: Path) -> None:
    # GIVEN a recording with a stop before cycle 2100 and its reset before cycle 2250
    path = tmp_path / "run.mcap"
    published = record_synthetic_log(path, cycles=2600, mode=1)
    # THEN its channels have every sample, bit for bit, and lines for both
    found = decoded(path)
    assert len(found["/state"]) == 260
    for _, state in found["/state"]:
        assert (state.status, state.stop) == tuple(published[state.cycle][k] for k in ("status", "stop"))
        assert bool(state.status & STOPPED) == (2100 <= state.cycle < 2250)
    lines = [line.message for _, line in found["/log"]]
    assert [t for t in lines if "stop " in t] == ["stop latched: request", "stop reset by the pose's holder"]
    # WHEN it is converted, THEN the table is whole, and equals what was published
    done = convert([path], "csv", rate_hz=0)
    assert (done.rows, done.differing, done.damage) == (2600, 0, [])
    table = read_table(Path(done.files[0]))
    for cycle, stop in zip(table["cycle"].tolist(), table["stop"].tolist()):
        assert int(stop) == published[int(cycle)]["stop"]


class Kept:
    """Keeps the messages' data."""

    wall_offset_ns = 0

    def __init__(self) -> None:
        self.data: list[bytes] = []

    def add_message(self, topic: str, kind: Message, t_ns: int, data: bytes) -> None:
        self.data.append(data)


def test_a_map_far_from_the_origin_is_logged_to_a_millimetre() -> None:
    kept = Kept()
    region_m = (512345.25, 5812345.25, 512346.75, 5812346.0)
    StandardChannels(kept, zeros(Params)).take(Event("map", 5, RQ_MAP_RESET, region_m))
    assert b"MapReset over 512345.25, 5812345.25, 512346.75, 5812346 m" in kept.data[0]
