"""Parts of a recorder: a source of log words, counts, a feed for viewers, a rotation of files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surffollow.record.recording_writer import RecordingWriter


class LogSource(Protocol):
    """A cycle log that can be followed."""

    @property
    def address(self) -> int:
        """Address of the `LogHead`."""

    @property
    def capacity(self) -> int:
        """Words of the log, a power of two."""

    @property
    def epoch(self) -> int:
        """Which start of the service writes it."""

    def alive(self) -> bool:
        """Whether its writer lives."""

    def reattach(self) -> bool:
        """Go over to a newer start's log; False when there is none."""


@dataclass
class Counts:
    """Counts of a recording: held and lost."""

    cycles: int = 0
    segments: int = 0
    losses: int = 0
    lost_words: int = 0
    lost_cycles: int = 0
    restarts: int = 0
    first_t_ns: int = 0
    last_t_ns: int = 0

    def as_text(self) -> dict[str, str]:
        """The numbers as the summary record keeps them."""
        return {name: str(value) for name, value in asdict(self).items()}


class Feed(Protocol):
    """Receiver of the recorded words: the standard channels."""

    def take(self, segment: int, words: NDArray[np.int64]) -> None:
        """A batch of whole entries of a segment, in order."""

    def change_file(self, writer: RecordingWriter) -> None:
        """Begin another file with the next words."""

    def finish(self) -> None:
        """Nothing more comes for this file."""


class Rotation(Protocol):
    """When to begin another file, and which."""

    def due(self, writer: RecordingWriter) -> bool:
        """Whether the file in progress is to end at the next snapshot."""

    def open_next(self) -> RecordingWriter:
        """The next file."""
