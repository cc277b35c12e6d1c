"""The segments of a recording for readers that can leave nothing out: whole, in order, each entry checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.record.log_kernels import entries_end
from surffollow.record.reader import RecordingReader, missing_words
from surffollow.shm.dtypes import zeros
from surffollow.shm.journal import SNAPSHOT, entry_kind
from surffollow.shm.layout_follow import Inputs


def whole_segments(reader: RecordingReader) -> list[NDArray[np.int64]]:
    """Words of each segment, in the order of the file.

    Parameters
    ----------
    reader : an open recording

    Raises
    ------
    RecordingError
        words are damaged, missing, repeated, or begin no entry; the text follows on "cannot be played: "
    """
    segments: dict[tuple[int, int], list[NDArray[np.int64]]] = {}
    ends: dict[tuple[int, int], int] = {}
    inputs, fault = zeros(Inputs), ""
    for batch in reader.batches():
        words = np.frombuffer(bytes(batch.words), np.int64)
        key = batch.segment, batch.epoch
        expected = ends.setdefault(key, batch.position)
        end = entries_end(words, words.view(np.float64), inputs)
        if batch.position != expected:
            fault = fault or missing_words(expected, batch.position)
        elif end < words.size:
            fault = fault or f"the word at {batch.position + end} begins no entry"
        elif key not in segments and words.size and entry_kind(words[0]) != SNAPSHOT:
            fault = fault or f"segment {batch.segment} does not begin with a snapshot"
        ends[key] = batch.position + words.size
        segments.setdefault(key, []).append(words)
    if reader.damage or fault:
        raise RecordingError(str(reader.damage) or fault)
    whole = [np.concatenate(runs) for runs in segments.values()]
    return [words for words in whole if words.size]
