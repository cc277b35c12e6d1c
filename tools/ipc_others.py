"""Other ways between two Python processes, for bench_ipc: what 64 bytes cost and how long they take.

Every way offers `post(n)`, `take() -> n` (the newest, or what has come; 0: nothing) and `wait(n)`. A peer in
a process of its own sends every message back; half a round trip is one hand-over.
"""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing as mp
import os
import struct
import time
from collections.abc import Callable
from multiprocessing import shared_memory
from typing import Any

MESSAGE = struct.Struct("<q7d")
POSE = (0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0)


class SharedStruct:
    """`multiprocessing.shared_memory` and `struct`: no protection against torn reads."""

    def __init__(self, name: str, side: int) -> None:
        if side == 0:
            self.memory = shared_memory.SharedMemory(name, create=True, size=4096)
        else:
            self.memory = shared_memory.SharedMemory(name)
        self.buffer: Any = self.memory.buf
        self.mine, self.other, self.side = 64 * 2 * side, 64 * 2 * (1 - side), side

    def post(self, n: int) -> None:
        MESSAGE.pack_into(self.buffer, self.mine, n, *POSE)

    def take(self) -> int:
        return int(MESSAGE.unpack_from(self.buffer, self.other)[0])

    def wait(self, n: int) -> None:
        while self.take() != n:
            pass

    def close(self) -> None:
        self.memory.close()
        if self.side == 0:
            self.memory.unlink()


class Semaphores(SharedStruct):
    """The same, with a POSIX semaphore each way to sleep on."""

    def __init__(self, name: str, side: int) -> None:
        import posix_ipc

        super().__init__(name, side)
        flags = posix_ipc.O_CREX if side == 0 else 0
        self.semaphores = [posix_ipc.Semaphore(f"/{name}-{k}", flags) for k in range(2)]

    def post(self, n: int) -> None:
        super().post(n)
        self.semaphores[self.side].release()

    def wait(self, n: int) -> None:
        while True:
            self.semaphores[1 - self.side].acquire()
            if self.take() == n:
                return

    def close(self) -> None:
        super().close()
        for s in self.semaphores:
            if self.side == 0:
                s.unlink()
            s.close()


class MessageQueue:
    """Two POSIX message queues."""

    def __init__(self, name: str, side: int) -> None:
        import posix_ipc

        flags = posix_ipc.O_CREX if side == 0 else 0
        options = {"max_messages": 8, "max_message_size": MESSAGE.size} if side == 0 else {}
        self.queues = [posix_ipc.MessageQueue(f"/{name}-{k}", flags, **options) for k in range(2)]
        self.side = side

    def post(self, n: int) -> None:
        self.queues[self.side].send(MESSAGE.pack(n, *POSE))

    def take(self) -> int:
        if self.queues[1 - self.side].current_messages == 0:
            return 0
        return int(MESSAGE.unpack(self.queues[1 - self.side].receive()[0])[0])

    def wait(self, n: int) -> None:
        while int(MESSAGE.unpack(self.queues[1 - self.side].receive()[0])[0]) != n:
            pass

    def close(self) -> None:
        for q in self.queues:
            if self.side == 0:
                q.unlink()
            q.close()


class Zmq:
    """A pair of pyzmq sockets over a Unix socket."""

    def __init__(self, name: str, side: int) -> None:
        import zmq

        self.context, self.again = zmq.Context(), zmq.Again
        self.socket = self.context.socket(zmq.PAIR)
        self.no_wait = zmq.NOBLOCK
        address = f"ipc:///tmp/{name}.zmq"
        (self.socket.bind if side == 0 else self.socket.connect)(address)

    def post(self, n: int) -> None:
        self.socket.send(MESSAGE.pack(n, *POSE))

    def take(self) -> int:
        try:
            return int(MESSAGE.unpack(self.socket.recv(self.no_wait))[0])
        except self.again:
            return 0

    def wait(self, n: int) -> None:
        while int(MESSAGE.unpack(self.socket.recv())[0]) != n:
            pass

    def close(self) -> None:
        self.socket.close(0)
        self.context.term()


class Record(ctypes.Structure):
    """The message as iceoryx2 wants it."""

    _fields_ = (("n", ctypes.c_int64), ("pose", ctypes.c_double * 7))

    @staticmethod
    def type_name() -> str:
        return "Record"


class Key(ctypes.Structure):
    """Key of a blackboard entry."""

    _fields_ = (("k", ctypes.c_uint32),)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Key) and self.k == other.k

    __hash__ = None  # type: ignore[assignment]

    @staticmethod
    def type_name() -> str:
        return "Key"


class _Iceoryx:
    def __init__(self) -> None:
        self.iox = importlib.import_module("iceoryx2")
        self.iox.set_log_level(self.iox.LogLevel.Error)
        self.node = self.iox.NodeBuilder.new().create(self.iox.ServiceType.Ipc)
        self.record = Record(0, (ctypes.c_double * 7)(*POSE))
        self.ports: list[Any] = []

    def service(self, name: str) -> Any:
        return self.node.service_builder(self.iox.ServiceName.new(name))

    def wait(self, n: int) -> None:
        while self.take() != n:
            pass

    def take(self) -> int:
        raise NotImplementedError

    def close(self) -> None:
        for port in reversed(self.ports):
            port.delete()


class IceoryxPubSub(_Iceoryx):
    """iceoryx2, publish and subscribe, a service each way."""

    def __init__(self, name: str, side: int) -> None:
        super().__init__()
        services = [self.service(f"{name}/{k}").publish_subscribe(Record).open_or_create() for k in range(2)]
        self.publisher = services[side].publisher_builder().create()
        self.subscriber = services[1 - side].subscriber_builder().create()
        self.ports = [self.publisher, self.subscriber]

    def post(self, n: int) -> None:
        self.record.n = n
        self.publisher.loan_uninit().write_payload(self.record).send()

    def take(self) -> int:
        n = 0
        while (sample := self.subscriber.receive()) is not None:
            n = int(sample.payload().contents.n)
        return n


class IceoryxBlackboard(_Iceoryx):
    """iceoryx2's blackboard, one each way."""

    def __init__(self, name: str, side: int) -> None:
        super().__init__()
        self.mine = self.service(f"{name}/b{side}").blackboard_creator(Key).add(Key(1), self.record).create()
        self.writer = self.mine.writer_builder().create()
        self.entry = self.writer.entry(Key(1), Record)
        self.ports = [self.writer]
        deadline = time.monotonic() + 20.0
        while True:
            try:
                self.other = self.service(f"{name}/b{1 - side}").blackboard_opener(Key).open()
                break
            except Exception:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)
        self.reader = self.other.reader_builder().create()
        self.handle = self.reader.entry(Key(1), Record)
        self.ports.append(self.reader)

    def post(self, n: int) -> None:
        self.record.n = n
        self.entry.update_with_copy(self.record)

    def take(self) -> int:
        return int(self.handle.get().decode_as(Record).n)


WAYS: dict[str, tuple[str, Callable[[str, int], Any]]] = {
    "shared_memory + struct": ("struct", SharedStruct),
    "shared_memory + semaphore": ("posix_ipc", Semaphores),
    "posix message queue": ("posix_ipc", MessageQueue),
    "pyzmq PAIR": ("zmq", Zmq),
    "iceoryx2 pub/sub": ("iceoryx2", IceoryxPubSub),
    "iceoryx2 blackboard": ("iceoryx2", IceoryxBlackboard),
}


def echo(way: str, name: str, first: int, last: int, ready: Any, over: Any) -> None:
    """Body of the peer: send `first` … `last` back as they come."""
    side = WAYS[way][1](name, 1)
    ready.set()
    for n in range(first, last + 1):
        side.wait(n)
        side.post(n)
    over.wait(60)
    side.close()


def measure(way: str, rounds: int) -> dict[str, float] | None:
    """Half round trip and cost of `post` and of `take` without a peer's doing [ns]; None: not installed."""
    module, make = WAYS[way]
    try:
        importlib.import_module(module)
    except ImportError:
        return None
    name, spawn = f"benchipc{os.getpid()}", mp.get_context("spawn")
    ready, over = spawn.Event(), spawn.Event()
    first = None if way == "iceoryx2 blackboard" else make(name, 0)
    peer = spawn.Process(target=echo, args=(way, name, 1, rounds, ready, over))
    peer.start()
    side = first if first is not None else make(name, 0)
    ready.wait(20)
    time.sleep(0.1)  # connections of some ways are made behind the scenes
    trips = []
    for n in range(1, rounds + 1):
        start = time.perf_counter_ns()
        side.post(n)
        side.wait(n)
        trips.append(time.perf_counter_ns() - start)
    takes = []
    for _ in range(300):
        start = time.perf_counter_ns()
        for _ in range(20):
            side.take()
        takes.append((time.perf_counter_ns() - start) / 20)
    over.set()
    peer.join(20)
    side.close()
    trips.sort()
    takes.sort()
    return {
        "handover_p50_ns": trips[len(trips) // 2] / 2,
        "handover_p99_ns": trips[int(len(trips) * 0.99)] / 2,
        "take_p50_ns": takes[len(takes) // 2],
    }
