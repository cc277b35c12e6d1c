"""A real service, recorded: the channels hold what its board showed at the same cycles."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from running_service import POSE, STANDOFF_M, Service, World, config_text, until
from surffollow.record.replay import replay_file
from surffollow.record.session import record_service

REGION = (0.0, 0.0, 0.1, 0.1)
# a recorder of a first start, whose channels are compiled for as long as it has recorded nothing
COMPILES = """
import sys, threading
from numba.core.compiler_lock import global_compiler_lock
from surffollow.record import samples, session
from surffollow.record.recorder import Recorder

recorded, poll = threading.Event(), Recorder.poll

def noted_poll(recorder):
    poll(recorder)
    if recorder.counts.cycles > 0:
        recorded.set()

def compile_channels(sampler):
    with global_compiler_lock:
        print(recorded.wait(20.0))

Recorder.poll = noted_poll
samples.Sampler.warm_up = compile_channels
samples.Sampler.feed = lambda sampler, words: iter(())
session.record_service(sys.argv[1], sys.argv[2], threading.Event(), seconds=0.1)
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory):
    """A recording, and what observers saw meanwhile: outputs by cycle, parameters, map, status."""
    folder = tmp_path_factory.mktemp("live_channels")
    service = Service(folder, config_text(kind="simulated"))
    world = None
    try:
        service.start()
        world = World(service.name)
        path, stop = folder / "run.mcap", threading.Event()
        recorder = threading.Thread(target=record_service, args=(service.name, path, stop))
        seen = {}
        with service.attach() as client:
            client.map_reset(REGION)
            client.ee_pos(POSE)
            recorder.start()
            until(lambda: path.exists() and path.stat().st_size > 200_000, "a recording")

            def watch():
                client.ee_pos(POSE)
                output = client.output()
                seen[output["cycle"]] = output
                return len(seen) > 1500

            until(watch, "outputs")
            client.set_params(permitted_variance="0.3 mm")
            until(
                lambda: (client.ee_pos(POSE), client.map_height(*POSE[:2]) == client.map_height(*POSE[:2]))[1]
            )
            params, height = client.params(), client.map_height(*POSE[:2])
            status = client.status()
            stop.set()
            recorder.join()
        decoded = {}
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, channel, message in reader.iter_messages():
                if schema.encoding == "protobuf":
                    decode = DecoderFactory().decoder_for("protobuf", schema)
                    decoded.setdefault(channel.topic, []).append(decode(message.data))
        return path, decoded, seen, params, height, status
    finally:
        if world is not None:
            world.close()
        service.purge()


def test_cycles_are_recorded_while_the_channels_are_compiled(service: Service, tmp_path: Path):
    # the first poll waited for the compiler: 31 s of cycles were lost on a busy machine
    done = subprocess.run(
        [sys.executable, "-c", COMPILES, service.name, str(tmp_path / "first.mcap")],
        env={**os.environ, "SURFFOLLOW_CACHE_DIR": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "True\n"


def test_the_recording_replays_bit_for_bit(run):
    report = replay_file(run[0])
    assert report.identical, report


def test_every_state_equals_the_output_that_an_observer_saw_in_that_cycle(run):
    _, decoded, seen, *_ = run
    common = [state for state in decoded["/state"] if state.cycle in seen]
    assert len(common) > 50
    for state in common:
        for name, value in seen[state.cycle].items():
            got = getattr(state, name)
            if isinstance(value, (list, tuple)):
                got = list(got)
                np.testing.assert_array_equal(got, list(value)[: len(got)], err_msg=name)
            elif name != "epoch":
                assert got == value or (math.isnan(got) and math.isnan(value)), name


def test_parameters_map_counters_and_distances_are_those_of_the_service(run):
    _, decoded, _, params, height, status = run
    last = decoded["/params"][-1]
    for name, value in params.items():
        assert getattr(last, name) == value, name
    service = decoded["/service"][-1]
    assert service.cycles >= status["cycles"]
    assert [s.cycles for s in decoded["/service"]] == sorted(s.cycles for s in decoded["/service"])
    assert service.poses >= status["poses"]
    assert sum(service.lateness) == pytest.approx(service.cycles, abs=5)
    cloud = decoded["/map"][-1]
    kinds = [(f.name, "u1" if f.type == 1 else "<f8") for f in cloud.fields]
    points = np.frombuffer(cloud.data, np.dtype(kinds))
    at = int(np.argmin(np.hypot(points["x"] - POSE[0], points["y"] - POSE[1])))
    assert abs(points["z"][at] - height) < 1e-3
    ranges = [scan.ranges[0] for scan in decoded["/beam/0"]]
    assert abs(np.median(ranges) - STANDOFF_M) < 1e-3
    assert any("parameters changed" in line.message for line in decoded["/log"])
