"""The state machine's table as a state diagram (Mermaid) and as a table (Markdown), for the documentation."""

from __future__ import annotations

from collections.abc import Sequence

from surffollow.arbiter import table as t


def _guards(row: t.Row) -> str:
    words = []
    for k, name in enumerate(t.GUARDS):
        if row.must >> k & 1:
            words.append(name)
        elif row.must_not >> k & 1:
            words.append(f"not {name}")
    return ", ".join(words)


def _names(values: Sequence[int], names: Sequence[str]) -> str:
    return " / ".join(names[v] for v in values)


def state_diagram(rows: Sequence[t.Row] = t.TABLE) -> str:
    """Mermaid text: one arrow for each pair of states, with the events that lead along it."""
    arrows: dict[tuple[int, int], list[str]] = {}
    for row in rows:
        for state in row.states:
            target = state if row.next_state == t.SAME else row.next_state
            if target == state and not row.actions:
                continue
            for event in row.events:
                labels = arrows.setdefault((state, target), [])
                name = t.EVENTS[event]
                if name not in labels:
                    labels.append(name)
    lines = ["```mermaid", "stateDiagram-v2", "    [*] --> FREE: RESTART"]
    for (state, target), labels in sorted(arrows.items()):
        if target == t.FREE and labels == ["RESTART"]:
            continue
        text = ", ".join(n for n in labels if n != "RESTART" or state == target)
        lines.append(f"    {t.STATES[state]} --> {t.STATES[target]}: {text}")
    return "\n".join([*lines, "```", ""])


def transition_table(rows: Sequence[t.Row] = t.TABLE) -> str:
    """Markdown: one line for each row."""
    lines = ["| # | state | event | guards | actions | next |", "| --- | --- | --- | --- | --- | --- |"]
    for k, row in enumerate(rows):
        target = "same" if row.next_state == t.SAME else t.STATES[row.next_state]
        actions = ", ".join(t.ACTIONS[a] for a in row.actions) or "–"
        states, events = _names(row.states, t.STATES), _names(row.events, t.EVENTS)
        lines.append(f"| {k} | {states} | {events} | {_guards(row) or '–'} | {actions} | {target} |")
    return "\n".join(lines) + "\n"
