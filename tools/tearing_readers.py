"""The readers that tools/bench_tearing.py races, in C, C++ and Python, and a writer that only publishes."""

from __future__ import annotations

import mmap
import shutil
import subprocess
import threading
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from surffollow.client.board import Board
from surffollow.client.latch_reader import LatchReader
from surffollow.shm import atomics as at
from surffollow.shm.cheader import HEADER
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_follow import Output
from surffollow.shm.schema import I64, Schema

WORDS = Output.SIZE // 8
TABLE_ENTRIES = 1 << 20


class Words(Schema):
    """A payload as long as `Output`."""

    word = I64(WORDS)


Counts = dict[str, int]


@njit(nogil=True)  # not kept: numba would not see a change of the package's kernels
def publish_until(latch: Any, payload: Any, stop: Any) -> Any:
    """Publish payloads whose words are all their generation, without a pause, until `stop` is set."""
    n, g = payload.shape[0], at.load_relaxed_i64(latch)
    while at.load_relaxed_i64(stop.ctypes.data) == 0:
        g += 1
        for k in range(n):
            payload[k] = g
        latch_write(latch, payload.ctypes.data, n * 8)
    return g


def full_speed_writer(path: str, seconds: float) -> None:
    """Body of the writer's process."""
    with open(path, "r+b") as f:
        memory = np.frombuffer(mmap.mmap(f.fileno(), 0), np.uint8)
    latch, payload, stop = int(memory.ctypes.data), np.zeros(WORDS, np.int64), np.ones(1, np.int64)
    publish_until(latch, payload, stop)  # compiles, and publishes nothing
    stop[0] = 0
    threading.Timer(seconds, stop.fill, (1,)).start()
    publish_until(latch, payload, stop)


def python_words(path: str, seconds: float) -> Counts:
    """The Python client's reader over the writer's latch."""
    with open(path, "rb") as f:
        memory = mmap.mmap(f.fileno(), 0, prot=mmap.PROT_READ)
    words = memoryview(memory).cast("Q")
    reader, count = LatchReader(words, memory, 0, Words), no_counts()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        before = words[0]
        data = reader.copy()
        count["reads"] += 1
        count["overlapped"] += words[0] != before
        if data is None:
            count["failed"] += before != 0
        else:
            count["torn"] += data != data[:8] * WORDS
    return count


def python_output(name: str, seconds: float, table_path: str) -> Counts:
    """The Python client's reader over a service's output; fills the table as latch_stress.c does."""
    board, count = Board(name), no_counts()
    words, index = board.words, board.regions["output"][0] // 8
    reader = board.latch("output", Output)
    at_cycle = Output.offset("cycle")
    table = np.zeros((TABLE_ENTRIES, 2), np.int64)
    first, cycle = b"", -1
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        before = words[index]
        data = reader.copy()
        count["reads"] += 1
        count["overlapped"] += words[index] != before
        if data is None:
            count["failed"] += 1
            continue
        now = int.from_bytes(data[at_cycle : at_cycle + 8], "little")
        if now == cycle:
            count["torn"] += data != first
            continue
        count["torn"] += now < cycle
        first, cycle = data, now
        table[now % TABLE_ENTRIES] = now, zlib.crc32(data)
    table.tofile(table_path)
    return count


def no_counts() -> Counts:
    """All that a reader counts, at zero."""
    return {"reads": 0, "overlapped": 0, "torn": 0, "failed": 0}


def compile_readers(folder: Path) -> dict[str, str]:
    """The C readers, as C and as C++; those for which there is a compiler."""
    source, out = str(Path(__file__).with_name("latch_stress.c")), {}
    compilers = []
    for language, compiler, flags in (
        ("C", "gcc", ["-std=c11"]),
        ("C++", "g++", ["-std=c++17", "-x", "c++"]),
    ):
        if shutil.which(compiler):
            out[language] = str(folder / f"stress-{compiler}")
            command = [compiler, *flags, "-O2", f"-I{HEADER.parent}", source, "-o", out[language]]
            compilers.append(subprocess.Popen(command))
    if any([c.wait() for c in compilers]):
        raise SystemExit("the readers do not compile")
    return out


def parse(text: str) -> Counts:
    """`reads 5 overlapped 1 ...` as counts."""
    words = text.split()
    return {words[i]: int(words[i + 1]) for i in range(0, len(words), 2)}


def race(pool: Any, programs: dict[str, list[str]], python: Any, *arguments: Any) -> dict[str, Counts]:
    """Run all readers at once, the one in Python in the pool's process; their counts."""
    started = {k: subprocess.Popen(v, stdout=subprocess.PIPE, text=True) for k, v in programs.items()}
    found = {"Python": pool.apply(python, arguments)}
    for language, process in started.items():
        text = process.communicate()[0]
        if process.returncode:
            raise SystemExit(f"the {language} reader ended with {process.returncode}")
        found[language] = parse(text)
    return found
