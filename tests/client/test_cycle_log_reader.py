"""The plain reader of the cycle log against the kernels that write it."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.client import cycle_log_reader as reader
from surffollow.client.cycle_log_reader import CycleLogReader, unpack_conversion
from surffollow.shm import conversion, journal
from surffollow.shm.board_regions import log_hash
from surffollow.shm.cycle_log import log_append
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.layout_board import LogHead
from surffollow.shm.layout_follow import Inputs, Output

CAPACITY = 1024


class LogBoard:
    """A board that has a cycle log and nothing else."""

    name = "log-only"

    def __init__(self) -> None:
        self.array = np.zeros(LogHead.SIZE // 8 + CAPACITY, np.int64)
        self.array[LogHead.offset("capacity") // 8] = CAPACITY
        self.memory = memoryview(self.array).cast("B")
        self.words = self.memory.cast("Q")
        self.regions = {"log": (0, self.array.nbytes)}
        self.hash = log_hash()

    def header(self) -> dict:
        return {"region": [{"name": "log", "hash": self.hash}]}

    def append(self, entry: np.ndarray, n: int) -> None:
        log_append(self.array.ctypes.data, CAPACITY, entry.ctypes.data, n)


def test_the_constants_are_those_of_the_kernels() -> None:
    for name in ("CYCLE", "CYCLE_HEAD"):
        assert getattr(reader, name) == getattr(journal, name)
    for name in ("FLAG_INVALID", "FLAG_OUTSIDE", "OUTSIDE_M"):
        assert getattr(reader, name) == getattr(conversion, name)


def test_poses_and_conversions_are_those_that_went_in() -> None:
    board, random = LogBoard(), np.random.default_rng(7)
    log = CycleLogReader(board)  # type: ignore[arg-type]
    words, poses, conversions = np.zeros(journal.CYCLE_MAX, np.int64), [], []
    for cycle in range(200):
        inputs, output = zeros(Inputs), zeros(Output)
        i = inputs[0]
        i["t_ns"], i["n_poses"], i["n_conversions"] = 10**6 * cycle, random.integers(5), random.integers(4)
        i["n_preview"] = random.integers(3)
        for k in range(i["n_poses"]):
            pose = random.normal(size=7)
            i["pose_t_ns"][k], i["pose"][7 * k : 7 * k + 7] = 10**6 * cycle + k, pose
            poses.append((10**6 * cycle + k, tuple(pose.tolist())))
        for k in range(i["n_conversions"]):
            counts, dt_ns = (
                int(random.integers(-(1 << 23), 1 << 23)),
                int(random.integers(-(1 << 31), 1 << 31)),
            )
            channel, flags = int(random.integers(8)), int(random.integers(32))
            i["conversion"][k] = conversion.pack_conversion(counts, channel, flags, dt_ns)
            conversions.append((10**6 * cycle + dt_ns, counts, channel, flags))
        n = journal.encode_cycle(words, words.view(np.float64), inputs, output)
        board.append(words, n)
        if cycle % 5 == 4:
            board.append(np.array([journal.RESET | 3 << 8, 0, 0]), 3)
            got = log.take()
            assert (got[0], got[1]) == (poses, conversions), f"seed 7, cycle {cycle}"
            poses, conversions = [], []
    assert log.lost == 0
    assert numpy_dtype(Inputs).itemsize == Inputs.SIZE


def test_words_that_were_overwritten_are_a_loss_and_reading_goes_on() -> None:
    board = LogBoard()
    log = CycleLogReader(board)  # type: ignore[arg-type]
    words, inputs = np.zeros(journal.CYCLE_MAX, np.int64), zeros(Inputs)
    inputs[0]["n_conversions"] = 1
    inputs[0]["conversion"][0] = conversion.pack_conversion(5, 1, 0, 0)
    n = journal.encode_cycle(words, words.view(np.float64), inputs, zeros(Output))
    for _ in range(CAPACITY // n + 1):
        board.append(words, n)
    assert log.take() == ([], [])
    assert log.lost == 1
    board.append(words, n)
    assert log.take() == ([], [unpack_conversion(int(inputs[0]["conversion"][0]), 0)])


def test_a_log_of_another_release_is_refused() -> None:
    board = LogBoard()
    board.hash += 1
    with pytest.raises(reader.LayoutMismatchError, match="one release"):
        CycleLogReader(board)  # type: ignore[arg-type]
