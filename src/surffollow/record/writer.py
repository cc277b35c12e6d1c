"""Write MCAP files that survive their writer's death: messages of protocol buffers for viewers."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO

from mcap.writer import CompressionType, Writer

from surffollow.errors import FaultError
from surffollow.map.formats.atomic_file import behind_links, stranger_in_shared_folder
from surffollow.record.format import (
    CHUNK_BYTES,
    CLOCK_NAME,
    PROFILE,
    SUMMARY_NAME,
)
from surffollow.record.protobuf import Message
from surffollow.record.protobuf_types import descriptor_set
from surffollow.release import program_version

if TYPE_CHECKING:
    from typing_extensions import Self

PROTOBUF = "protobuf"
MARK_BYTES = 8  # at the beginning of an MCAP file; with them alone it holds nothing


def wall_offset_ns() -> int:
    """CLOCK_REALTIME less CLOCK_MONOTONIC now, from the closest of a few looks at both."""
    looks = []
    for _ in range(5):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after - before, wall - (before + after) // 2))
    return min(looks)[1]


class MessageWriter:
    """An open MCAP file for messages of protocol buffers; a channel and its schema are declared at first use.

    Each finished chunk goes to the kernel at once, so that a killed process loses only
    the chunk it was filling. LZ4 because the replay must read a million cycles a second:
    it stores a default log in 0.30 of its size and costs 0.12 s per million cycles to
    read (zstd: 0.14 and 0.33 s; none: 1 and 0.15 s for the checksum alone).

    Parameters
    ----------
    path : where to write
    stream : instead of opening `path` (for trials)
    force : replace an existing file
    wall_offset : CLOCK_REALTIME less CLOCK_MONOTONIC [ns]; log times are wall-clock times by it,
        publish times those of CLOCK_MONOTONIC. None: as the clocks say now. 0: no wall clock is known
    target : `path` is a temporary file that becomes this one when it is whole; errors name this one

    Raises
    ------
    FaultError  the file is there already, is no plain file, or cannot be opened or written
    """

    def __init__(
        self,
        path: str | Path,
        *,
        stream: BinaryIO | None = None,
        force: bool = False,
        wall_offset: int | None = None,
        target: Path | None = None,
    ) -> None:
        self.path, self._target = Path(path), target
        self.bytes_written = 0
        self.messages = 0
        self.wall_offset_ns = wall_offset_ns() if wall_offset is None else wall_offset
        self._whole = 0
        self._opened = stream is None
        self._finished = False
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        if stream is None and os.path.exists(self.path) and not os.path.isfile(self.path):
            # a pipe would wait for its reader, and a device keeps nothing
            raise FaultError(f"recording {self.path} is there and is no plain file; choose another --out")
        try:
            # unbuffered below: the kernel has the data when `write` returns
            self._stream: Any = stream or _opened(self.path, force)
        except BlockingIOError:
            raise FaultError(f"another process records into {self.path}; choose another --out") from None
        except FileExistsError:
            raise FaultError(
                f"recording {self.path} exists already; choose another --out, or replace it with --force"
            ) from None
        except OSError as e:
            raise FaultError(
                f"cannot write recording {self.path}: {e.strerror}; choose another --out"
            ) from None
        sink: Any = _Sink(self)
        self._mcap = Writer(
            sink, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_data_crcs=True
        )
        self._guard(self._begin)

    def _begin(self) -> None:
        self._mcap.start(PROFILE, f"surffollow {program_version()}")

    def note_clock(self) -> None:
        """Say in a metadata record what the times are."""
        known = self.wall_offset_ns != 0
        clock = {
            "wall_minus_monotonic_ns": str(self.wall_offset_ns),
            "log_time": "CLOCK_REALTIME" if known else "CLOCK_MONOTONIC (the wall clock is not known)",
            "publish_time": "CLOCK_MONOTONIC",
        }
        self._guard(self._mcap.add_metadata, CLOCK_NAME, clock)

    def declare(self, topic: str, kind: Message, about: dict[str, str] | None = None) -> None:
        """Declare a channel before its first message, with texts that stay with it."""
        self._guard(self._channel_of, topic, kind, about)

    def _channel_of(self, topic: str, kind: Message, about: dict[str, str] | None = None) -> int:
        if topic not in self._channels:
            name = kind.full_name
            if name not in self._schemas:
                self._schemas[name] = self._mcap.register_schema(name, PROTOBUF, descriptor_set(kind))
            schema = self._schemas[name]
            self._channels[topic] = self._mcap.register_channel(topic, PROTOBUF, schema, about or {})
        return self._channels[topic]

    def add_message(self, topic: str, kind: Message, t_ns: int, data: bytes) -> None:
        """Append one message.

        Parameters
        ----------
        topic : of the channel, which always has messages of one kind
        kind : its type
        t_ns : int64        CLOCK_MONOTONIC [ns]
        data : encoded with `kind`

        Raises
        ------
        FaultError  the disk is full or gone; what was written stays readable
        """
        self._guard(self._append, topic, kind, t_ns, data)
        self.messages += 1

    def _append(self, topic: str, kind: Message, t_ns: int, data: bytes) -> None:
        log_ns = max(0, t_ns + self.wall_offset_ns)
        self._mcap.add_message(self._channel_of(topic, kind), log_ns, data, max(0, t_ns), self.messages)

    def finish(self, summary: dict[str, str]) -> None:
        """Write the summary record, the indexes and the end mark, and close the file."""
        if self._finished:
            return
        self.note_clock()
        self._guard(self._mcap.add_metadata, SUMMARY_NAME, summary)
        self._guard(self._mcap.finish)
        self.close()

    def close(self) -> None:
        """Close the file as it is; without `finish` it counts as cut short."""
        self._finished = True
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._finished:
            self.close()

    def _guard(self, call: Any, *arguments: Any) -> None:
        try:
            call(*arguments)
        except OSError as e:
            self._give_up()
            what, remedy = str(e.strerror), "free some space or choose another --out"
            if e.errno in (errno.ENOSPC, errno.EDQUOT):
                what = "the disk is full"
            elif e.errno == errno.EFBIG:
                what = "no file may be larger here"
                remedy = "raise the limit (ulimit -f)"
                remedy += "" if self._target is not None else ", or rotate files (--rotate-size)"
            if self._target is not None:
                raise FaultError(f"cannot write {self._target}: {what}; {remedy}") from None
            some = self._whole > MARK_BYTES
            kept = "it is readable up to there (surffollow replay)" if some else "nothing was recorded"
            raise FaultError(
                f"recording {self.path} ends after {self._whole} bytes: {what}; {kept}; {remedy}"
            ) from None

    def _give_up(self) -> None:
        self._finished = True
        # where that fails, the reader recognises the half record at the end
        with contextlib.suppress(OSError, AttributeError, ValueError):
            os.ftruncate(self._stream.fileno(), self._whole)
            if self._whole <= MARK_BYTES and self._opened:  # nothing: the next recording may have the name
                os.unlink(os.path.realpath(self.path))
        self._stream.close()


def _opened(path: Path, force: bool) -> io.FileIO:
    """A new file, or with `force` an emptied one; locked, so that no other recorder empties it meanwhile.

    Raises
    ------
    BlockingIOError
        another recorder holds it
    FaultError
        it is a link or a file of another user in a shared folder, who could change what is written
    """
    if force:
        path = behind_links(path)
        if os.path.lexists(path) and (owner := stranger_in_shared_folder(path)) >= 0:
            raise FaultError(f"recording {path} is a file of user {owner}; choose another --out")
    flags = os.O_WRONLY | os.O_CREAT | (os.O_NOFOLLOW if force else os.O_EXCL)
    stream = open(path, "wb", buffering=0, opener=lambda name, _: os.open(name, flags, 0o666))  # noqa: SIM115
    try:
        fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise
    except OSError:
        pass  # a file system without locks
    stream.truncate()
    return stream


class _Sink:
    """File of the MCAP writer: counts bytes, and remembers where the last whole record ended."""

    def __init__(self, owner: MessageWriter) -> None:
        self._owner = owner

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while len(view):
            n = self._owner._stream.write(view)
            if not n:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            view = view[n:]
            self._owner.bytes_written += n
        # the MCAP writer hands over whole records only
        self._owner._whole = self._owner.bytes_written
        return len(data)

    def tell(self) -> int:
        return self._owner.bytes_written

    def flush(self) -> None:
        return None
