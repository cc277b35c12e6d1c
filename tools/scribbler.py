"""A hostile client of bench_fuzz: it writes random bytes and well-formed commands into its slot."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from surffollow.config.params import PARAMS
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.layout_follow import Params


class Writer:
    """Writes into the memory of a slot."""

    def __init__(self, memory: Any, seed: int) -> None:
        self.bytes = np.frombuffer(memory, np.uint8)
        self.words = self.bytes.view(np.int64)
        self.rng = np.random.default_rng(seed)
        self.pool = self.rng.integers(0, 256, 1 << 22, dtype=np.uint8)
        self.names = [(Params.offset(n) // 8, spec) for n, spec in PARAMS.items()]

    def noise(self) -> None:
        """Random bytes anywhere, and random or small words where they hurt most."""
        rng = self.rng
        for size in (1 << 20, 65536, 4096, 64, 8, 1):
            size = min(size, len(self.bytes))
            at = int(rng.integers(0, len(self.bytes) - size + 1))
            start = int(rng.integers(0, len(self.pool) - size))
            self.bytes[at : at + size] = self.pool[start : start + size]
        for _ in range(50):
            place = int(
                rng.choice(
                    [0, ls.SLOT_POSE // 8, ls.SLOT_REQUEST // 8, ls.SLOT_RANGES // 8, ls.SLOT_STREAM // 8]
                )
            )
            value = int(rng.choice([0, 1, 2, 3, -1, -(2**63), 2**63 - 1, int(rng.integers(2**62))]))
            self.words[place] = value

    def post(self, latch: int, size: int, payload: Any) -> None:
        """Publish a payload as a client would."""
        index = latch // 8
        g = int(self.words[index]) + 1 & (2**62 - 1)
        at = latch + HEAD_BYTES + (g & (SLOTS - 1)) * stride(size)
        self.bytes[at : at + size] = np.frombuffer(payload, np.uint8)
        self.words[index] = g

    def pose(self) -> None:
        quaternion = self.rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        place = self.rng.choice([0.0, 0.1, 10.0, 1e5, 0.999e9], size=3) * self.rng.normal(size=3)
        post = np.zeros(8)
        post[1:4], post[4:] = place, quaternion
        post[:1].view(np.int64)[0] = time.monotonic_ns() + int(self.rng.integers(-100_000_000, 2_000_000))
        self.post(ls.SLOT_POSE, ls.PosePost.SIZE, post.tobytes())

    def request(self, counter: int) -> None:
        rng, n = self.rng, int(self.rng.integers(1, ls.REQUEST_ARGS + 1))
        post = np.zeros(ls.RequestPost.SIZE // 8)
        whole = post.view(np.int64)
        code = int(rng.integers(0, lb.RQ_RELEASE_RANGE + 2))
        whole[0], whole[1], whole[2], whole[3] = counter, code, n, int(rng.integers(2**62))
        number, value = whole[4 : 4 + ls.REQUEST_ARGS], post[4 + ls.REQUEST_ARGS :]
        if code == lb.RQ_SET_PARAMS:
            for k in range(n):
                word, spec = self.names[int(rng.integers(len(self.names)))]
                number[k] = word
                value[k] = rng.choice([spec.low, spec.high, spec.default, math.nan])
                if rng.integers(2):
                    value[k] = spec.low + (spec.high - spec.low) * rng.random() ** 8
                if spec.whole and value[k] == value[k]:
                    value[k] = round(float(value[k]))
        else:
            value[:4] = rng.choice([0.0, 0.1, -0.1, 1e3, -1e5, 1e-9, 1e21, math.inf], size=4)
            number[:] = rng.integers(-2, 1 << 40, ls.REQUEST_ARGS)
            if code == lb.RQ_CLAIM_RANGE:
                number[0] = rng.integers(1, 9)  # channel 0 is the robot's, who may be away for a moment
        self.post(ls.SLOT_REQUEST, ls.RequestPost.SIZE, post.tobytes())

    def ranges(self) -> None:
        """A burst of well-formed items: any channel, times around now, distances that make others' wrong."""
        head, now_ns = ls.SLOT_RANGES // 8, time.monotonic_ns()
        for _ in range(int(self.rng.integers(1, 200))):
            number = int(self.words[head]) + 1 & (2**62 - 1)
            at = ls.SLOT_RANGES + ls.RANGES_AT + (number - 1 & ls.RANGE_ITEMS - 1) * ls.RangeItem.SIZE
            item = np.zeros(4)
            item[3] = self.rng.choice([0.06, 0.14, math.nan, math.inf, -1.0, 1e300])
            t_ns = now_ns + int(self.rng.integers(-2_000_000_000, 4_000_000))
            item[:3].view(np.int64)[:] = number, t_ns, int(self.rng.integers(-1, 9))
            self.bytes[at : at + 32] = item.view(np.uint8)
            self.words[head] = number

    def commands(self, counter: int) -> None:
        """A well-formed pose, ranges, and a request with extreme values."""
        self.pose()
        self.ranges()
        self.request(counter)
        if counter % 16 == 0:
            self.words[0] = int(self.rng.integers(4))
