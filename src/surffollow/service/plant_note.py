"""A learned time constant at an end of its range: named in the status's note, and by replays."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.plant.plant_identification import TAU_RATIO
from surffollow.shm.layout_adaptive import N_PLANTS
from surffollow.shm.layout_follow import MODE_ADAPTIVE, Params
from surffollow.shm.python_atomics import load_acquire
from surffollow.units import format_ns

REACH = TAU_RATIO ** (N_PLANTS // 2)  # of τ from the configured value, up and down
NEAR_END = 0.15  # of the value at the end: waves make a τ beyond it look somewhat less extreme
TAU_AT_END = "the learned time constant of the axis"


def tau_note(tau_s: float, configured_s: float) -> str:
    """Text about a learned time constant that is near an end of its range; empty otherwise.

    Parameters
    ----------
    tau_s : learned [s]; 0: nothing is learned yet
    configured_s : plant_tau at the SFReset before [s]
    """
    if not (tau_s > 0.0 and configured_s > 0.0):
        return ""
    ratio = tau_s / configured_s
    if (1.0 + NEAR_END) / REACH < ratio < (1.0 - NEAR_END) * REACH:
        return ""
    tau, configured, low, high = (
        format_ns(1e9 * v) for v in (tau_s, configured_s, configured_s / REACH, configured_s * REACH)
    )
    return (
        f"{TAU_AT_END}, {tau}, is at an end of what is learned from plant_tau {configured} ({low} to "
        f"{high}): measure it and set plant_tau, or report newer poses (docs/how-to/tune-the-follower.md)"
    )


def state_note(params: Any, state: Any) -> str:
    """`tau_note` of a follower; empty in the paper's mode.

    Parameters
    ----------
    params, state : (1,) records of `Params`, `FollowState`
    """
    if int(load_acquire(params.ctypes.data + Params.offset("mode"))) != MODE_ADAPTIVE:
        return ""
    plant, time = state[0]["adaptive"]["plant"], float(state[0]["scaled"]["time"])
    return tau_note(time * float(plant["tau_s"]), time * float(plant["tau_configured_s"]))


class PlantWatch:
    """The note, while the service runs.

    Parameters
    ----------
    params, state : (1,) records of `Params`, `FollowState`, which the cycle thread changes
    """

    def __init__(self, params: Any, state: Any) -> None:
        self._params, self._state = params, state

    def notes(self) -> list[str]:
        """A line where the learned time constant is at an end of its range (main thread)."""
        note = state_note(self._params, self._state)
        return [note] if note else []
