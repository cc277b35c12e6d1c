"""A function that numba has no more, or in another form, is left alone; kernels compile without it."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core import base, errors, ir, lowering, postproc, typeinfer, types
from numba.core.registry import cpu_target
from numba.core.typing import Context

from surffollow.shm import compiler_shortcuts, typing_memory, variable_lifetimes
from surffollow.shm.jit import jit
from surffollow.shm.replaced_functions import is_known, replaced


def named():
    """Which functions of numba are replaced while a kernel compiles."""
    found = [
        *compiler_shortcuts._replacements(),
        *typing_memory._replacements(cpu_target.typing_context),
        *variable_lifetimes._replacements(),
    ]
    return [name for _, name, _ in found]


def as_other_version(*lost, **kept):
    """A function with one more parameter."""


def sum_of(values, factor):
    total = 0.0
    for k in range(len(values)):
        total += min(values[k], factor)
    return total + values[0]


def test_this_version_of_numba_has_all_functions_as_they_are_known():
    assert named() == [
        *("get_function", "_find", "_has_loc", "new_error_context", "new_error_context", "__instancecheck__"),
        *("resolve_function_type", "get_call_type", "run", "_rec_list_vars"),
    ]


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (base.BaseContext, "get_function"),
        (base.OverloadSelector, "_find"),
        (base, "_has_loc"),
        (errors, "new_error_context"),
        (lowering, "new_error_context"),
        (typeinfer, "new_error_context"),
        (type(types.Type), "__instancecheck__"),
        (Context, "resolve_function_type"),
        (Context, "_lookup_global"),
        (types.Function, "get_call_type"),
        (postproc.PostProcessor, "run"),
        (ir.Inst, "_rec_list_vars"),
    ],
)
def test_a_function_that_takes_something_else_stays_as_it_is(monkeypatch, owner, name):
    before = named()
    monkeypatch.setattr(owner, name, as_other_version, raising=False)
    assert len(named()) < len(before)


@pytest.mark.parametrize(
    ("owner", "name"), [(postproc.PostProcessor, "run"), (ir.Inst, "_rec_list_vars"), (base, "_has_loc")]
)
def test_a_function_that_is_gone_is_not_made(monkeypatch, owner, name):
    before = named()
    monkeypatch.delattr(owner, name)
    assert [n for n in before if n != name] == named()


def test_a_function_that_does_more_is_left_to_do_it(monkeypatch):
    run = postproc.PostProcessor.run

    def does_more(self, emit_dels=False, extend_lifetimes=False):
        self.func_ir.something_new = True
        run(self, emit_dels, extend_lifetimes)

    monkeypatch.setattr(postproc.PostProcessor, "run", does_more)
    assert is_known(postproc.PostProcessor, "run", "self emit_dels extend_lifetimes")
    assert "run" not in named()


def test_kernels_compile_where_nothing_is_known(monkeypatch):
    for module in (compiler_shortcuts, typing_memory, variable_lifetimes):
        monkeypatch.setattr(module, "is_known", lambda *_: False)
    monkeypatch.setattr(type(types.Type), "__instancecheck__", type.__instancecheck__, raising=False)
    assert named() == []
    assert jit(sum_of)(np.array((0.5, 3.0)), 1.0) == 2.0


def test_kernels_compile_where_numba_keeps_its_options_otherwise(monkeypatch):
    monkeypatch.delattr(typing_memory.targetconfig, "ConfigStack")
    known = dict(typing_memory._known)
    found = cpu_target.typing_context.resolve_value_type(min)
    calls = []
    typing_memory._recall(lambda: calls.append(1), found, (types.int64, types.int64))
    assert calls == [1]
    assert typing_memory._known == known


def test_what_was_inherited_is_inherited_again_after_an_error():
    class Base:
        def one(self):
            return 1

    class Kind(Base):
        pass

    def find():
        yield Kind, "one", lambda self: 2
        yield Base, "one", lambda self: 3

    def fail():
        with replaced(find) as outermost, replaced(find) as again:
            assert (outermost, again) == (True, False)
            assert (Kind().one(), Base().one()) == (2, 3)
            raise RuntimeError

    for _ in range(2):
        with pytest.raises(RuntimeError):
            fail()
        assert (Kind().one(), "one" in vars(Kind)) == (1, False)
