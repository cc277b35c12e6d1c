"""Percentiles from the board's histograms: 8 bins per octave of nanoseconds."""

from __future__ import annotations

from collections.abc import Sequence


def bin_edges_ns(bin_index: int) -> tuple[float, float]:
    """Lower and upper edge of a histogram bin [ns].

    Bin b < 8 holds exactly b ns; above, bins are 8 to the octave.
    """
    if bin_index < 8:
        return float(bin_index), float(bin_index + 1)
    octave, part = divmod(bin_index - 8, 8)
    width = float(1 << octave)
    return (8 + part) * width, (9 + part) * width


def percentile_ns(counts: Sequence[int], fraction: float) -> float:
    """The value below which a fraction of the counted durations lie, linear within a bin [ns]."""
    total = sum(counts)
    if total == 0:
        return float("nan")
    expected, seen = fraction * total, 0
    for b, n in enumerate(counts):
        if n and seen + n >= expected:
            low, high = bin_edges_ns(b)
            return low + (high - low) * max(0.0, (expected - seen) / n)
        seen += n
    return bin_edges_ns(len(counts) - 1)[1]


def histogram_summary(counts: Sequence[int], most_ns: int) -> dict[str, float]:
    """p50, p99, p99.9 and maximum [ns] of a histogram."""
    names = {"p50_ns": 0.5, "p99_ns": 0.99, "p99_9_ns": 0.999}
    if not sum(counts):
        return {n: 0.0 for n in names} | {"max_ns": 0.0}
    out = {n: min(percentile_ns(counts, f), float(most_ns)) for n, f in names.items()}
    return out | {"max_ns": float(most_ns)}
