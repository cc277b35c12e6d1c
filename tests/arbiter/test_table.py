"""The table that the server runs: no fault under any policy, and every altered table is caught."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.arbiter import table as t
from surffollow.arbiter.check import check_table, is_caught
from surffollow.arbiter.memory import make_memory
from surffollow.arbiter.mutants import mutants


@pytest.fixture(scope="module")
def found():
    """Result of the exploration of the table, per policy."""
    return check_table()


def test_no_step_of_any_policy_breaks_a_property(found):
    print({f.policy: f.states for f in found})
    assert [f.fault for f in found] == ["", "", "", ""]
    assert all(f.states > 200 and f.steps > 15_000 for f in found)


def test_equal_and_descending_priorities_are_without_fault_too():
    for priorities in ((1, 1, 1), (3, 2, 1), (1, 2, 2)):
        assert not any(f.fault for f in check_table(priorities=priorities)), priorities


def test_every_row_is_needed(found):
    used = set()
    for f in found:
        used |= set(f.rows_used)
    assert used == set(range(len(t.TABLE)))


def test_every_altered_table_is_caught():
    survivors, tried = [], 0
    for what, rows in mutants():
        tried += 1
        if not is_caught(rows):
            survivors.append(what)
    print(tried, "altered tables")
    assert tried > 1000
    assert survivors == []


def test_the_server_runs_the_table_that_is_checked():
    np.testing.assert_array_equal(make_memory().table, np.array(t.encode(t.TABLE)))
