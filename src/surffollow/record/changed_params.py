"""Step a recording with other parameters than the recorded ones.

The entries of the log are changed before the follower takes them: the parameters of SNAPSHOT and PARAMS
entries, and the stand-off of RESET entries. The given values thus hold for the whole run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS as TABLE
from surffollow.config.params import UNIT_ENDINGS, add_given, check_param, param_name
from surffollow.config.window_fit import FITTED, check_fit
from surffollow.errors import ConfigError, UsageError
from surffollow.record.log_kernels import entry_length
from surffollow.record.samples import Event, Sampler
from surffollow.record.step_samples import STARTED
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.journal import PARAMS, PARAMS_WORDS, RESET, SNAPSHOT, entry_head, entry_kind
from surffollow.shm.layout_follow import Params

# changes of these count from an SFReset on
FROM_RESET = ("offset_m", "plant_tau_s")
# fields of `Params` that are no parameters: sensors, and the stops of the configuration
_FIXED = {name for name in (f.name for f in Params.FIELDS) if name not in TABLE}
_SWITCHES = {"true": True, "false": False}


def read_changes(texts: Iterable[str]) -> dict[str, float]:
    """Parameters given as "NAME=VALUE": full name → value in the parameter's unit.

    Parameters
    ----------
    texts : names with or without their ending, values as in a configuration file, without quotes

    Raises
    ------
    UsageError   no name or no value
    ConfigError  unknown name, one that a replay cannot change, wrong unit, out of bounds, given twice
    """
    given: dict[str, str] = {}
    values: dict[str, float] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not name or not equals or not value:
            raise UsageError(f"--set {text}: write NAME=VALUE, for instance --set plant_tau='50 ms'")
        if any(name + ending in _FIXED for ending in UNIT_ENDINGS):
            raise ConfigError(
                f"--set {name}: a replay cannot change it, because it describes the sensors or the stops of "
                "the recorded service; change the configuration and record again"
            )
        try:
            full = param_name(name)
            add_given(given, full, name, " with --set")
            values[full] = check_param(name, _typed(value))
        except ConfigError as error:
            raise ConfigError(f"--set {text}: {error}") from None
    return values


def _typed(text: str) -> object:
    """A value as a configuration file would hold it: a number, a truth value or text."""
    if text in _SWITCHES:
        return _SWITCHES[text]
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text) if "_" not in text else text
    return text


def set_values(entry: NDArray[np.int64], values: Mapping[str, float]) -> bool:
    """Put values in place of those of a SNAPSHOT or PARAMS entry; whether they count from an SFReset on.

    Parameters
    ----------
    entry : (n,) int64  the whole entry, updated
    values : by full name
    """
    params: NDArray[Any] = entry[2 : 2 + PARAMS_WORDS].view(numpy_dtype(Params))
    begins = any(name in values and params[name][0] != values[name] for name in FROM_RESET)
    for name, value in values.items():
        params[name] = value
    return begins


class ChangedSampler(Sampler):
    """A sampler whose follower has other parameters than the recorded one.

    The state at the beginning of a segment is the recorded one. Where the stand-off or the time constant
    differs, an SFReset follows it, as it has to in a service.

    Parameters
    ----------
    period_ns : see `Sampler`
    values : parameters by full name, checked
    """

    def __init__(self, period_ns: int, values: Mapping[str, float]) -> None:
        self._values = dict(values)
        super().__init__(period_ns)

    def _event(self, words: NDArray[np.int64], at: int) -> Event:
        kind, end = int(entry_kind(words[at])), at + int(entry_length(words[at]))
        begins = kind == SNAPSHOT and not self._plan[STARTED]
        if end == at or end > words.size or not (begins or kind in (PARAMS, RESET)):
            return super()._event(words, at)
        entry, restart = words[at:end].copy(), False
        if kind != RESET:
            restart = set_values(entry, self._values)
        elif "offset_m" in self._values:
            entry.view(np.float64)[2] = self._values["offset_m"]
        event = super()._event(entry, 0)
        try:  # as the service does in every change
            check_fit({name: float(self.params[name][0]) for name in FITTED})
        except ConfigError as error:
            raise ConfigError(f"--set does not fit the recorded parameters: {error}") from None
        if begins and restart:
            reset = np.array([entry_head(RESET, 3), entry[1], 0], np.int64)
            reset.view(np.float64)[2] = float(self.params[0]["offset_m"])
            super()._event(reset, 0)
        return event
