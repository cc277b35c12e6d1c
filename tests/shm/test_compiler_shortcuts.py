"""Shortcuts of compilation: the same errors, numba as before afterwards, fewer searches."""

from __future__ import annotations

import numpy as np
import pytest
from numba import typeof
from numba.core import base, errors, lowering, typeinfer, types
from numba.core.registry import cpu_target
from numba.core.typing import signature

from surffollow.shm.compiler_shortcuts import shortcuts
from surffollow.shm.jit import jit


@jit
def unknown_attribute(a):
    return a.is_nothing_that_numba_knows


def functions_of_numba():
    context = base.BaseContext
    found = (context.get_function, base.OverloadSelector._find, base._has_loc)
    return (*found, lowering.new_error_context, typeinfer.new_error_context)


def test_an_implementation_that_is_missing_is_searched_once(monkeypatch):
    context, kind = cpu_target.target_context, typeof(np.zeros(4))
    constant_index = signature(types.float64, kind, types.literal(0))
    refreshed = []
    monkeypatch.setattr(base.BaseContext, "refresh", lambda self: refreshed.append(1))
    with shortcuts():
        for _ in range(3):
            with pytest.raises(NotImplementedError):
                context.get_function("static_getitem", constant_index)
    assert len(refreshed) == 1


def test_an_error_names_the_line_and_numba_is_as_before():
    before = functions_of_numba()
    with pytest.raises(errors.TypingError, match=r"typing of get attribute at .*test_compiler_sho"):
        unknown_attribute(np.zeros(4))
    assert functions_of_numba() == before
    assert "__instancecheck__" not in vars(type(types.Type))  # that of all types is the ordinary one


def test_a_call_under_the_shortcuts_has_room_for_its_frames():
    with shortcuts() as call, shortcuts() as inner_call:
        assert call.__code__.co_stacksize * 8 > 1 << 19  # Python maps a chunk of twice that
        assert inner_call.__code__.co_stacksize < 100  # one such chunk is enough
        assert call(lambda: 7) == inner_call(lambda: 7) == 7
