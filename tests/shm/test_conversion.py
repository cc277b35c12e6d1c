"""The conversion word: every field comes back, none disturbs another."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from surffollow.shm import conversion as cv


@settings(max_examples=500, deadline=None)
@given(
    st.integers(cv.COUNTS_MIN, cv.COUNTS_MAX),
    st.integers(0, 7),
    st.integers(0, 31),
    st.integers(-(1 << 31), (1 << 31) - 1),
)
def test_a_conversion_comes_back_from_its_word(counts, channel, flags, dt_ns):
    word = cv.pack_conversion(counts, channel, flags, dt_ns)
    assert -(1 << 63) <= word < 1 << 63
    got = cv.conversion_counts(word), cv.conversion_channel(word), cv.conversion_flags(word)
    assert got == (counts, channel, flags)
    assert cv.conversion_dt_ns(word) == dt_ns


@settings(max_examples=300, deadline=None)
@given(st.integers(-(1 << 63), (1 << 63) - 1))
def test_every_word_is_some_conversion(word):
    parts = cv.conversion_counts(word), cv.conversion_channel(word), cv.conversion_flags(word)
    assert cv.COUNTS_MIN <= parts[0] <= cv.COUNTS_MAX
    assert 0 <= parts[1] <= 7
    assert 0 <= parts[2] <= 31
    assert cv.pack_conversion(*parts, cv.conversion_dt_ns(word)) == word


def test_the_bits_lie_where_the_protocol_says():
    assert cv.pack_conversion(-1, 0, 0, 0) == 0xFFFFFF
    assert cv.pack_conversion(0, 7, 0, 0) == 7 << 24
    assert cv.pack_conversion(0, 0, 31, 0) == 31 << 27
    assert cv.pack_conversion(0, 0, 0, 1) == 1 << 32
    assert cv.pack_conversion(0, 0, 0, -1) == -(1 << 32)
