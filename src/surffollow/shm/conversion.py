"""One A/D conversion in one 64-bit word, as drivers deliver it and the log keeps it.

Bits 0-23: counts, two's complement; 24-26: channel; 27-31: flags; 32-63: time
relative to a reference [ns], two's complement (0 in a driver's queue, where the
timestamp has a word of its own; the cycle's time in `Inputs` and in the log).
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit_pasted

FLAG_INVALID = 1  # the driver knows that this is no measurement (out of view, over-range, NaN)
# with FLAG_INVALID: a distance that counts cannot hold; its counts are multiples of OUTSIDE_M, for messages
FLAG_OUTSIDE = 2
OUTSIDE_M = 0.01
COUNTS_MIN, COUNTS_MAX = -(1 << 23), (1 << 23) - 1
# words of one item in a driver's queue: timestamp, conversion
ITEM_WORDS = 2


@jit_pasted
def pack_conversion(counts: Any, channel: Any, flags: Any, dt_ns: Any) -> Any:
    """The word of a conversion.

    Parameters
    ----------
    counts : int64      within COUNTS_MIN … COUNTS_MAX
    channel : int64     0 … 7
    flags : int64       FLAG_…, 5 bits
    dt_ns : int64 [ns]  time relative to a reference, 32 bits

    Returns
    -------
    int64
    """
    return (dt_ns << 32) | ((flags & 31) << 27) | ((channel & 7) << 24) | (counts & 0xFFFFFF)


@jit_pasted
def conversion_counts(word: Any) -> Any:
    """Counts, -2**23 to 2**23-1."""
    return ((word & 0xFFFFFF) ^ 0x800000) - 0x800000


@jit_pasted
def conversion_channel(word: Any) -> Any:
    """Channel, 0 to 7."""
    return (word >> 24) & 7


@jit_pasted
def conversion_flags(word: Any) -> Any:
    """Flags, see FLAG_…"""
    return (word >> 27) & 31


@jit_pasted
def conversion_dt_ns(word: Any) -> Any:
    """Time relative to the reference [ns]."""
    return word >> 32
