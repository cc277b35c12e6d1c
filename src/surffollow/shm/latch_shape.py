"""The shape of a latch in memory, for programs that do not load numba (see `latch`)."""

SLOTS = 4
HEAD_BYTES = 64
MAX_TRIES = 16


def stride(payload_bytes: int) -> int:
    """Bytes from one slot to the next: whole cache lines."""
    return -(-payload_bytes // 64) * 64


def latch_bytes(payload_bytes: int) -> int:
    """Bytes of a latch over a payload of that size (a multiple of 8)."""
    return HEAD_BYTES + SLOTS * stride(payload_bytes)
