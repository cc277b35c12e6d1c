"""The A/D converter of the simulation: a MIZAR M28605-2-00, free-running over the enabled channels.

12 bits, 8 differential channels, 25 kHz in all. Conversions have numbers: number n ends at n · 40 µs of
CLOCK_MONOTONIC and belongs to channel n mod (channels enabled), for every reader at any time.
"""

from __future__ import annotations

from typing import Any

from surffollow.hw.simulation.counter_noise import hashed_normal
from surffollow.shm.jit import jit, jit_pasted

BITS = 12
CHANNELS = 8
AGGREGATE_HZ = 25_000
CONVERSION_NS = 1_000_000_000 // AGGREGATE_HZ
FULL_SCALE_V = 10.0
COUNTS = 1 << BITS
STREAM_ADC = 7


@jit
def quantise(volts: Any) -> Any:
    """Counts of a voltage, 0 to 4095; beyond the input range the end of the scale (NaN: its upper end).

    Parameters
    ----------
    volts : float64 [V]

    Returns
    -------
    int64 counts
    """
    counts = volts * (COUNTS / FULL_SCALE_V)
    if counts < 0.0:
        return 0
    if counts < COUNTS:
        return int(counts)
    return COUNTS - 1


@jit
def convert(volts: Any, noise_counts: Any, seed: Any, number: Any) -> Any:
    """Counts of conversion `number`, the converter's own noise included.

    Parameters
    ----------
    volts : float64 [V]
    noise_counts : float64, standard deviation in counts
    seed, number : int64

    Returns
    -------
    int64 counts, 0 to 4095
    """
    noise_v = hashed_normal(seed, STREAM_ADC, number) * noise_counts * (FULL_SCALE_V / COUNTS)
    return quantise(volts + noise_v)


@jit_pasted
def first_number_from(t_ns: Any) -> Any:
    """Return the number of the first conversion that ends at `t_ns` or later [ns]."""
    return -(-t_ns // CONVERSION_NS)


def calibration(near_m: float, far_m: float) -> tuple[float, float]:
    """Scale [m/count] and zero [m] of a sensor that gives 0 V at `near_m` and full scale at `far_m`.

    A count stands for the middle of its quantum, hence the half.
    """
    scale_m = (far_m - near_m) / COUNTS
    return scale_m, near_m + 0.5 * scale_m
