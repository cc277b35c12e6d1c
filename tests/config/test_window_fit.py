"""Window, stand-off and fold-back: one rule, and a text for every way to break it."""

from __future__ import annotations

import pytest

from surffollow.config.window_fit import FITTED, MISFITS, check_fit, misfit
from surffollow.errors import ConfigError

FIT = (0.05, 0.15, 0.1, 0.054, 0.058)  # range_min, range_max, offset, too_close, too_close_exit


@pytest.mark.parametrize(
    "values",
    [FIT, (0.05, 0.15, 0.1, 0.05, 0.05), (0.05, 0.15, 0.1, 0.0, 0.058), (0.0, 0.15, 0.1, 0.0, 0.0)],
)
def test_what_fits_is_accepted(values):
    assert misfit(*values) == -1
    check_fit(dict(zip(FITTED, values, strict=True)))


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ((0.15, 0.15, 0.1, 0.054, 0.058), "range_min_m"),
        ((0.05, 0.15, 0.05, 0.054, 0.058), "offset_m"),
        ((0.05, 0.15, 0.15, 0.054, 0.058), "offset_m"),
        ((0.05, 0.15, 0.1, 0.059, 0.058), "too_close_m"),
        ((0.05, 0.15, 0.1, 0.054, 0.15), "too_close_exit_m"),
        ((0.05, 0.15, 0.054, 0.054, 0.058), "too_close_m"),
        ((0.055, 0.15, 0.1, 0.054, 0.058), "too_close_m"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_parameter_and_its_value(values, name):
    assert MISFITS[misfit(*values)][0] == name
    with pytest.raises(ConfigError, match=f"^{name} {values[FITTED.index(name)]:g} m"):
        check_fit(dict(zip(FITTED, values, strict=True)))


@pytest.mark.parametrize("k", range(len(FITTED)))
def test_nan_fits_nowhere(k):
    values = list(FIT)
    values[k] = float("nan")
    assert misfit(*values) >= 0
