"""Record a real service with standard channels: the recorder's processor time, the file's size, the replay.

A service, a simulated robot on rolling ground and `surffollow record` run as processes of their own. The
recorder's processor time is taken from /proc once it writes, so that loading kernels is told by itself. The
same words are then replayed with and without the channels beside them, in turn.

    python tools/bench_record.py [--seconds 60] [--rate 100] [--json]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from report import criterion, finish, result
from service_process import COMMAND, await_ready, remove_objects
from surffollow.record.format import CHUNK_BYTES, TOPIC
from surffollow.record.replay import replay_file

SHARE_LIMIT = 0.15


def processor_s(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wait_for(condition: Any, what: str, seconds: float = 300.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"{what} did not happen in {seconds:g} s")
        time.sleep(0.1)


def record(folder: Path, seconds: float, rate: float) -> dict[str, Any]:
    """Run the three processes; the recorder's figures and the file."""
    name, path = f"bench-record-{os.getpid()}", folder / "run.mcap"
    children: list[subprocess.Popen[Any]] = []
    try:
        words = [*COMMAND, "start", "--name", name, "--quiet"]
        service = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        children.append(service)
        await_ready(service)
        robot = [*COMMAND, "simulate", "--name", name, "--path", "raster", "--seconds", "0", "--json"]
        children.append(subprocess.Popen(robot, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        words = ["record", "--name", name, "--out", str(path), "--rate", str(rate), "--json"]
        began = time.monotonic()
        recorder = subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL)
        children.append(recorder)
        wait_for(lambda: path.exists() and path.stat().st_size > 500_000, "a recording")
        # by then kernels are loaded and the backlog is worked off
        wait_for(lambda: time.monotonic() - began > 10.0, "the recorder's settling")
        loading, size, t = processor_s(recorder.pid), path.stat().st_size, time.monotonic()
        time.sleep(seconds)
        spent = processor_s(recorder.pid) - loading
        took, grown = time.monotonic() - t, path.stat().st_size - size
        recorder.send_signal(signal.SIGTERM)
        recorder.wait()
        return {"path": path, "share": spent / took, "loading_s": loading, "bytes_per_min": 60 * grown / took}
    finally:
        for child in reversed(children):
            child.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(15)
        remove_objects(name)


def words_alone(path: Path, out: Path) -> None:
    """The cycle log of a recording in a file of its own."""
    with open(path, "rb") as source, open(out, "wb") as target:
        writer = Writer(
            target, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_data_crcs=True
        )
        writer.start("surffollow", "bench")
        number = None
        reader = make_reader(source)
        for schema, channel, message in reader.iter_messages(topics=[TOPIC], log_time_order=False):
            if number is None:
                assert schema is not None
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                number = writer.register_channel(
                    channel.topic, channel.message_encoding, known, channel.metadata
                )
            writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()


def main() -> int:
    """Measure and print; 1 when a criterion is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        got = record(folder, o.seconds, o.rate)
        bare = folder / "bare.mcap"
        words_alone(got["path"], bare)
        both: dict[Path, list[float]] = {got["path"]: [], bare: []}
        reports = [replay_file(path) for path in both]
        for _ in range(5):
            for path, times in both.items():
                begin = time.process_time()
                replay_file(path)
                times.append(time.process_time() - begin)
        slower = float(np.median(both[got["path"]]) / np.median(both[bare]))
        minutes = reports[0].cycles / 60_000
        share_of_words = bare.stat().st_size / got["path"].stat().st_size
        criteria = [
            criterion("recorder's processor time", got["share"], SHARE_LIMIT, "of a core"),
            criterion("replay not identical", float(not all(r.identical for r in reports)), 0.0, ""),
        ]
        notes = [
            f"size: {got['bytes_per_min'] / 1e6:.1f} MB/min at {o.rate:g} samples/s, of which the words that "
            f"replay needs {share_of_words:.0%} ({minutes:.2f} min recorded)",
            f"kernels, backlog and start: {got['loading_s']:.1f} s of processor time once",
            f"replay beside channels takes {slower:.2f} times that of the words alone",
        ]
        return finish(
            result(
                f"recording of {reports[0].cycles} cycles",
                criteria,
                notes,
                bytes_per_min=got["bytes_per_min"],
                share=got["share"],
                loading_s=got["loading_s"],
                replay_ratio=slower,
                share_of_words=share_of_words,
            )
        )


if __name__ == "__main__":
    sys.exit(main())
