"""Since when and why a stop is latched, by entries of the audit trail."""

from __future__ import annotations

from typing import Any

from surffollow.client.stop_report import latched_by


def entry(request: str, age_s: float, **fields: Any) -> dict[str, Any]:
    plain = {"client": "arm", "pid": 7, "uid": 0, "slot": 3, "causes": ["request"], "reason": ""}
    return plain | {"request": request, "age_s": age_s, "accepted": True} | fields


def test_a_word_and_its_request_are_one_and_a_stop_before_a_reset_is_none() -> None:
    found = latched_by(
        [
            entry("stop", 9.0, reason="of yesterday"),
            entry("stop_reset", 8.0),
            entry("stop", 7.0),
            entry("stop", 6.9, reason="smoke"),
            entry("set_params", 6.0),
            entry("stop_reset", 5.0, accepted=False),
            entry("stop", 4.0, slot=-1, client="service", pid=1, causes=["driver"], reason="port: away"),
            entry("stop", 3.0, slot=-1, client="service", pid=1, causes=["stuck"]),
        ]
    )
    assert [(e["age_s"], e["client"], e["causes"], e["reason"]) for e in found] == [
        (7.0, "arm", ["request"], "smoke"),
        (4.0, "service", ["driver"], "port: away"),
        (3.0, "service", ["stuck"], ""),
    ]
