"""The independent audit finds what a server must not do in a history, and nothing in an honest one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from arbiter.running import until
from surffollow.arbiter import attach, table
from surffollow.arbiter import layout as al

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from arbiter_audit import (
    ATTACH,
    DETACH,
    EVENTS,
    FORWARD,
    GRANT,
    RELEASE,
    REVOKE,
    SAFE,
    Book,
    Follower,
)

EPOCH = 7
TOKEN, OTHER = EPOCH << 32 | 1, EPOCH << 32 | 2


def test_the_audits_numbers_are_the_servers():
    numbers = (GRANT, REVOKE, RELEASE, SAFE, FORWARD, ATTACH, DETACH)
    assert [al.EVENT_NAMES[n] for n in numbers] == [
        "GRANT", "REVOKE", "RELEASE", "SAFE", "FORWARD", "ATTACH", "DETACH",
    ]  # fmt: skip
    assert set(al.EVENT_NAMES) == EVENTS
    assert table.GRANT_HEAD not in EVENTS


def records(*steps):
    """(client, resource, token, event) → whole records, a millisecond apart."""
    return [[k + 1, 1_000_000 * k, *step[:3], step[3], 0, 0, *(0.0,) * 8] for k, step in enumerate(steps)]


HONEST = [
    (1, -1, 0, ATTACH),
    (2, -1, 0, ATTACH),
    (1, 0, TOKEN, GRANT),
    (1, 0, TOKEN, FORWARD),
    (1, 0, TOKEN, REVOKE),
    (0, 0, 0, SAFE),
    (2, 0, OTHER, GRANT),
    (1, 1, TOKEN | 1 << 28, GRANT),
    (2, 0, OTHER, FORWARD),
    (1, 1, TOKEN | 1 << 28, RELEASE),
    (0, 1, 0, SAFE),
    (1, -1, 0, DETACH),
]


def judged(rows):
    book = Book()
    book.epoch = EPOCH
    for row in rows:
        book.enter(tuple(row))
    book.end(rows[-1][1] + 10**10)
    return [v.split(":")[0] for v in book.violations]


def changed(index, column, value):
    rows = records(*HONEST)
    rows[index][column] = value
    return rows


def test_an_honest_history_is_blamed_for_nothing():
    assert judged(records(*HONEST)) == []


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        (records(*HONEST)[:3] + records(*HONEST)[4:], "the record after 3 is missing, or repeated"),
        (records(*HONEST)[:4] + records(*HONEST)[3:], "the record after 4 is missing, or repeated"),
        (changed(8, 1, 0), "time runs back"),
        (changed(3, 5, 2), "no such event"),
        (changed(3, 5, 77), "no such event"),
        (records(*HONEST[:5], *HONEST[6:]), "no safe command after a loss of control"),
        (records(*HONEST[:5]), "no safe command after a loss of control"),
        (changed(5, 1, 10**10), "the safe command after a loss of control is late"),
        (changed(5, 3, 1), "no safe command after a loss of control"),
        (changed(6, 4, TOKEN), "a token is not higher than all before"),
        (changed(7, 4, TOKEN), "a token was given before"),
        (changed(6, 4, OTHER + (1 << 32)), "a token is of another epoch"),
        (changed(7, 3, 0), "granted while held"),
        (changed(6, 2, 3), "granted to nobody"),
        (changed(3, 2, 2), "forwarded a command of a client that does not hold the resource"),
        (changed(8, 4, TOKEN), "forwarded a command of a client that does not hold the resource"),
        (changed(4, 4, OTHER), "took what was not held"),
        (changed(11, 2, 2), "a client that is gone still holds something"),
    ],
)
def test_a_forged_history_is_found(rows, why):
    assert why in judged(rows)


def test_what_was_overwritten_is_not_held_against_what_follows():
    book = Book()
    rows = [tuple(r) for r in records(*HONEST)]
    for row in rows[:3]:
        book.enter(row)
    book.lose(4)
    for row in rows[7:]:
        book.enter(row)
    assert book.violations == []
    assert book.counts["lost"] == 4
    book.enter((13, 10**9, 1, 1, TOKEN | 1 << 28, FORWARD, 0, 0, *(0.0,) * 8))
    assert len(book.violations) == 1  # of resource 1 it knows again


def test_two_resources_of_a_real_server_are_audited_together(arbiter):
    book = Book()
    with attach(arbiter.name, "go") as go:
        robot, camera = go.resource("robot"), go.resource("camera")
        for _ in range(3):
            assert robot.request()
            assert camera.request()
            assert robot.token != camera.token
            assert camera.command(0.1)
            until(lambda: go.exchange.words[go.exchange.consumed] == go.exchange.post[8])
            robot.relinquish()
            camera.relinquish()
    follower = Follower(Path(f"/dev/shm/{arbiter.name}.arbiter"))
    book.epoch = follower.epoch
    until(lambda: follower.read(book) == 0 and book.counts["grants"] >= 6)
    assert book.violations == []
    assert book.counts["forwarded"] == 3
