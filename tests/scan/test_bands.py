"""Bands of rows: all rows once, and an end by Ctrl-C waits for the bands that run, not for the rest."""

from __future__ import annotations

from threading import Event

import pytest

from surffollow.scan import bands
from surffollow.scan.bands import MAX_ROWS, in_bands


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("rows", [0, 1, 40, 10 * MAX_ROWS + 7])
def test_every_row_is_in_one_short_band(rows: int, threads: int) -> None:
    found: list[tuple[int, int]] = []
    in_bands(rows, lambda first, last: found.append((first, last)), threads=threads)
    assert [row for band in sorted(found) for row in range(*band)] == list(range(rows))
    assert all(last - first <= 2 * MAX_ROWS for first, last in found)


@pytest.mark.parametrize("threads", [1, 2])
def test_after_an_interrupt_no_further_band_is_begun(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    ending, begun = Event(), list[int]()

    def work(first: int, _: int) -> None:
        begun.append(first)
        if first == 0:
            raise KeyboardInterrupt
        ending.wait(60)  # a band that runs while the other one is interrupted

    class Pool(bands.ThreadPoolExecutor):
        def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
            super().shutdown(False, cancel_futures=cancel_futures)
            ending.set()
            super().shutdown(wait)

    monkeypatch.setattr(bands, "ThreadPoolExecutor", Pool)
    with pytest.raises(KeyboardInterrupt):
        in_bands(50 * MAX_ROWS, work, threads=threads)
    assert len(begun) <= threads + 1
