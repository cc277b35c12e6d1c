"""Write recordings: batches of cycle-log words beside messages for viewers."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from surffollow.record.format import (
    HEAD_WORDS,
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    SCHEMA_NAME,
    TOPIC,
    layout_description,
)
from surffollow.record.writer import MessageWriter


class RecordingWriter(MessageWriter):
    """An open recording: batches of cycle-log words, and standard channels beside them.

    Parameters
    ----------
    path, stream, force : see `MessageWriter`
    about : text values kept with the layout: name, period, …
    """

    def __init__(
        self,
        path: str | Path,
        about: dict[str, str] | None = None,
        *,
        stream: BinaryIO | None = None,
        force: bool = False,
    ) -> None:
        self._about = dict(about or {})
        super().__init__(path, stream=stream, force=force)

    def _begin(self) -> None:
        super()._begin()
        about = {**self._about, "wall_minus_monotonic_ns": str(self.wall_offset_ns)}
        schema = self._mcap.register_schema(SCHEMA_NAME, SCHEMA_ENCODING, layout_description(about))
        self._channel = self._mcap.register_channel(TOPIC, MESSAGE_ENCODING, schema, about)
        self._sequence = 0

    def add_batch(
        self,
        segment: int,
        epoch: int,
        position: int,
        cycles: int,
        words: NDArray[np.int64],
        first_t_ns: int,
        last_t_ns: int,
    ) -> None:
        """Append whole entries.

        Parameters
        ----------
        segment, epoch, position, cycles : int   see `BatchHead`
        words : (n,) int64
        first_t_ns, last_t_ns : int              timestamps of the first and the last entry [ns]

        Raises
        ------
        FaultError  the disk is full or gone; what was written stays readable
        """
        head = np.array([segment, epoch, position, cycles], np.int64)
        assert head.size == HEAD_WORDS
        data = head.tobytes() + words.tobytes()
        log_ns = first_t_ns + self.wall_offset_ns
        self._guard(self._mcap.add_message, self._channel, log_ns, data, last_t_ns, self._sequence)
        self._sequence += 1
