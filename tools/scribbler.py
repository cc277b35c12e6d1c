"""The hostile client of bench_fuzz: scribbles over all that members of the inbox group may write.

python tools/scribbler.py NAME bytes|commands|neighbour SEED
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np

from surffollow.config.params import PARAMS
from surffollow.shm import layout_board as lb
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.layout_follow import Params
from surffollow.shm.objects import SharedObject


class Writer:
    """Writes into the memory of an inbox."""

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
            slot = (lb.PAGE + int(rng.integers(lb.CLIENTS)) * lb.SLOT_BYTES) // 8
            place = int(rng.choice([0, 1, 2, 3, lb.SLOT_POSE // 8, lb.SLOT_REQUEST // 8]))
            value = int(rng.choice([0, 1, 2, 3, -1, -(2**63), 2**63 - 1, int(rng.integers(2**62))]))
            self.words[slot + place] = value

    def post(self, latch: int, size: int, payload: Any) -> None:
        """Publish a payload as a client would."""
        index = latch // 8
        g = int(self.words[index]) + 1 & (2**62 - 1)
        at = latch + HEAD_BYTES + (g & (SLOTS - 1)) * stride(size)
        self.bytes[at : at + size] = np.frombuffer(payload, np.uint8)
        self.words[index] = g

    def pose(self, slot: int) -> None:
        quaternion = self.rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        place = self.rng.choice([0.0, 0.1, 10.0, 1e5, 0.999e9], size=3) * self.rng.normal(size=3)
        post = np.zeros(8)
        post[1:4], post[4:] = place, quaternion
        post[:1].view(np.int64)[0] = time.monotonic_ns() + int(self.rng.integers(-100_000_000, 2_000_000))
        self.post(slot + lb.SLOT_POSE, lb.PosePost.SIZE, post.tobytes())

    def request(self, slot: int, counter: int) -> None:
        rng, n = self.rng, int(self.rng.integers(1, lb.REQUEST_ARGS + 1))
        post = np.zeros(lb.RequestPost.SIZE // 8)
        whole = post.view(np.int64)
        code = int(rng.integers(0, 10))
        whole[0], whole[1], whole[2], whole[3] = counter, code, n, int(rng.integers(2**62))
        number, value = whole[4 : 4 + lb.REQUEST_ARGS], post[4 + lb.REQUEST_ARGS :]
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
            number[:] = rng.integers(-2, 1 << 40, lb.REQUEST_ARGS)
        self.post(slot + lb.SLOT_REQUEST, lb.RequestPost.SIZE, post.tobytes())

    def commands(self, counter: int) -> None:
        """Well-formed poses and requests in everybody's name."""
        slot = lb.PAGE + int(self.rng.integers(lb.CLIENTS)) * lb.SLOT_BYTES
        self.pose(slot)
        self.request(slot, counter)
        if counter % 16 == 0:
            self.words[slot // 8 + 3] = int(self.rng.integers(4))


def write(name: str, kind: str, seed: int) -> None:
    """Scribble until killed; tells how often after every thousand."""
    if kind == "neighbour":
        memory: Any = bytearray(lb.inbox_bytes())
    else:
        inbox = SharedObject.open(f"{name}.inbox", writable=True)
        memory = inbox.memory
    writer, n = Writer(memory, seed), 0
    while True:
        n += 1
        if kind == "commands":
            writer.commands(n)
        else:
            writer.noise()
        if n % 1000 == 0 or n == 1:
            print(n, flush=True)


if __name__ == "__main__":
    write(sys.argv[1], sys.argv[2], int(sys.argv[3]))
