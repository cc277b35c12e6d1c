"""Every small change of the table, for the proof that the check would see it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from surffollow.arbiter import table as t

Mutant = tuple[str, tuple[t.Row, ...]]


def _text(k: int, row: t.Row) -> str:
    events = "/".join(t.EVENTS[e] for e in row.events)
    return f"row {k} ({events} in {'/'.join(t.STATES[s] for s in row.states)})"


def _variants(row: t.Row) -> Iterator[tuple[str, t.Row]]:
    for g, name in enumerate(t.GUARDS):
        bit = 1 << g
        if row.must & bit:
            yield f"without guard {name}", row._replace(must=row.must & ~bit)
            yield f"guard {name} negated", row._replace(must=row.must & ~bit, must_not=row.must_not | bit)
        elif row.must_not & bit:
            yield f"without guard not {name}", row._replace(must_not=row.must_not & ~bit)
            yield f"guard not {name} negated", row._replace(must=row.must | bit, must_not=row.must_not & ~bit)
    for k, action in enumerate(row.actions):
        rest = (row.actions[:k], row.actions[k + 1 :])
        yield f"without {t.ACTIONS[action]}", row._replace(actions=rest[0] + rest[1])
        for other in range(1, len(t.ACTIONS)):
            if other != action:
                text = f"{t.ACTIONS[other]} for {t.ACTIONS[action]}"
                yield text, row._replace(actions=(*rest[0], other, *rest[1]))
        if k:
            swapped = (*row.actions[: k - 1], action, row.actions[k - 1], *row.actions[k + 1 :])
            yield f"{t.ACTIONS[action]} sooner", row._replace(actions=swapped)
    if len(row.actions) < t.MAX_ACTIONS:
        for other in range(1, len(t.ACTIONS)):
            yield f"{t.ACTIONS[other]} added", row._replace(actions=(*row.actions, other))
    for state in (t.SAME, *range(len(t.STATES))):
        # from one state only, to stay and to go to that state are the same
        same = row.states == (state,) and row.next_state == t.SAME
        if state != row.next_state and not same and not (state == t.SAME and row.states == (row.next_state,)):
            yield f"next state {state}", row._replace(next_state=state)
    for state in row.states:
        yield f"not in {t.STATES[state]}", row._replace(states=tuple(s for s in row.states if s != state))
    for event in row.events:
        yield f"not on {t.EVENTS[event]}", row._replace(events=tuple(e for e in row.events if e != event))


def mutants(rows: Sequence[t.Row] = t.TABLE) -> Iterator[Mutant]:
    """Tables with one row dropped, or one guard, action, state or event of a row altered.

    Yields
    ------
    (what was changed, the changed table)
    """
    rows = tuple(rows)
    for k, row in enumerate(rows):
        before, after = rows[:k], rows[k + 1 :]
        yield f"{_text(k, row)} dropped", before + after
        for what, changed in _variants(row):
            yield f"{_text(k, row)}: {what}", (*before, changed, *after)
