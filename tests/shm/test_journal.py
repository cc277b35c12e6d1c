"""Cycle-log entries: what is written comes back, and a damaged entry is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surffollow.shm import journal
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import CHANNELS, MAX_CONVERSIONS, MAX_POSES, MAX_PREVIEW, Inputs, Output

i64 = st.integers(-(2**63), 2**63 - 1)
f64 = st.floats()


def words_for(n=journal.CYCLE_MAX):
    words = np.full(n, -1, np.int64)
    return words, words.view(np.float64)


def random_cycle(seed):
    rng = np.random.default_rng(seed)
    inputs, output = zeros(Inputs), zeros(Output)
    for record in (inputs, output):
        record.view(np.int64)[:] = rng.integers(-(2**63), 2**63, record.nbytes // 8, dtype=np.int64)
    i = inputs[0]
    i["n_conversions"] = rng.integers(0, MAX_CONVERSIONS + 1)
    i["n_poses"] = rng.integers(0, MAX_POSES + 1)
    i["n_ranges"] = rng.choice([0, rng.integers(1, CHANNELS + 1)])
    i["n_preview"] = rng.choice([0, rng.integers(1, MAX_PREVIEW + 1)])
    return inputs, output


def same(a, b):
    """Compare all that a cycle uses of two `Inputs`, NaN and all, as bits."""
    for name, used in (
        ("t_ns", 1),
        ("conversion", int(a["n_conversions"])),
        ("pose_t_ns", int(a["n_poses"])),
        ("pose", 7 * int(a["n_poses"])),
        ("given_m", int(a["n_ranges"])),
        ("preview_m", int(a["n_preview"])),
        ("preview_from_m", min(1, int(a["n_preview"]))),
        ("preview_step_m", min(1, int(a["n_preview"]))),
    ):
        left, right = (np.atleast_1d(v[name])[:used].tobytes() for v in (a, b))
        if left != right:
            return False
    return all(a[n] == b[n] for n in ("n_conversions", "n_poses", "n_ranges", "n_preview")) and (
        a["n_ranges"] == 0 or a["given_t_ns"] == b["given_t_ns"]
    )


@pytest.mark.parametrize("seed", range(30))
def test_a_cycle_comes_back_with_every_bit(seed):
    inputs, output = random_cycle(seed)
    words, floats = words_for()
    n = journal.encode_cycle(words, floats, inputs, output)
    back = zeros(Inputs)
    assert journal.entry_kind(int(words[0])) == journal.CYCLE
    assert journal.entry_words(int(words[0])) == n
    assert journal.decode_cycle(words, floats, 0, back) == n
    assert same(inputs[0], back[0]), f"seed {seed}"
    assert (words[n:] == -1).all()
    at = Output.offset("demand") // 8
    out_words = output.view(np.int64)
    o = output[0]
    assert journal.same_outcome(words, 0, out_words, at, o["status"], o["cycle"]) == 1


@pytest.mark.parametrize("word", [2, 3, *range(4, 10)])
def test_one_bit_of_difference_in_the_outcome_is_seen(word):
    inputs, output = random_cycle(1)
    words, floats = words_for()
    journal.encode_cycle(words, floats, inputs, output)
    words[word] ^= 1
    o = output[0]
    at = Output.offset("demand") // 8
    assert journal.same_outcome(words, 0, output.view(np.int64), at, o["status"], o["cycle"]) == 0


@settings(max_examples=300, deadline=None)
@given(st.lists(i64, min_size=journal.CYCLE_HEAD, max_size=200), st.data())
def test_damaged_entries_are_refused_or_stay_inside_their_own_words(values, data):
    words = np.array(values, np.int64)
    if data.draw(st.booleans()):  # a head that nearly fits
        counts = data.draw(st.tuples(*[st.integers(0, 255)] * 3))
        n = journal.CYCLE_HEAD + counts[0] + 8 * counts[1] + (1 + counts[2] if counts[2] else 0)
        n += data.draw(st.sampled_from([0, 0, 1, -1]))
        words[0] = journal.CYCLE | n << 8 | counts[0] << 32 | counts[1] << 40 | counts[2] << 48
    back = zeros(Inputs)
    got = journal.decode_cycle(words, words.view(np.float64), 0, back)
    i = back[0]
    if got == -1:
        assert not back.view(np.int64).any(), "a refused entry left something behind"
    else:
        assert journal.CYCLE_HEAD <= got <= words.size
        assert 0 <= i["n_conversions"] <= MAX_CONVERSIONS
        assert 0 <= i["n_poses"] <= MAX_POSES
        assert 0 <= i["n_ranges"] <= CHANNELS
        assert 0 <= i["n_preview"] <= MAX_PREVIEW


def test_a_full_cycle_fits_the_entry():
    inputs, output = random_cycle(2)
    i = inputs[0]
    i["n_conversions"], i["n_poses"], i["n_ranges"] = MAX_CONVERSIONS, MAX_POSES, CHANNELS
    i["n_preview"] = MAX_PREVIEW
    words, floats = words_for()
    assert journal.encode_cycle(words, floats, inputs, output) == journal.CYCLE_MAX


def test_heads_keep_kind_and_length():
    for kind, n in ((journal.SNAPSHOT, journal.SNAPSHOT_WORDS), (journal.RESET, 3), (255, (1 << 24) - 1)):
        head = journal.entry_head(kind, n)
        assert (journal.entry_kind(head), journal.entry_words(head)) == (kind, n)
