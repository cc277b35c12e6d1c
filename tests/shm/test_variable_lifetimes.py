"""The lists of variables are numba's, and numba's own functions are back after a kernel."""

from __future__ import annotations

from numba.core import compiler, ir, postproc

from surffollow.shm import variable_lifetimes as lifetimes
from surffollow.shm.jit import jit


def mixed(values, wanted):
    """Calls, tuples, branches and a loop."""
    total, pair = 0.0, (wanted, 2)
    for k in range(len(values)):
        if values[k] > pair[0]:
            total += min(values[k], 1.0 * pair[1])
    return total


def test_statements_have_the_variables_that_numba_finds():
    blocks = compiler.run_frontend(mixed).blocks.values()
    parts = [s for b in blocks for s in b.body]
    parts += [s.value for s in parts if isinstance(s, ir.Assign) and isinstance(s.value, ir.Inst)]
    assert len(parts) > 30
    for part in parts:
        want = [v.name for v in part._rec_list_vars(vars(part))]
        assert [v.name for v in lifetimes._list(part, vars(part))] == want


def test_only_the_ends_of_variables_ask_for_lifetimes():
    function = compiler.run_frontend(mixed)
    function.block_entry_vars.clear()
    with lifetimes.lifetimes_when_used():
        postproc.PostProcessor(function).run()
        assert not function.block_entry_vars
        postproc.PostProcessor(function).run(True)
    assert function.block_entry_vars
    assert any(isinstance(s, ir.Del) for b in function.blocks.values() for s in b.body)


def test_functions_of_numba_are_as_before_after_a_kernel():
    before = postproc.PostProcessor.run, ir.Inst._rec_list_vars
    assert jit(mixed)((0.5, 3.0), 1.0) == 2.0
    assert (postproc.PostProcessor.run, ir.Inst._rec_list_vars) == before
