"""The independent audit accepts an honest history and finds forged ones."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from arbiter_audit import AuditState, Entry, Follower, audit_file
from running_service import until
from surffollow.arbiter import attach
from surffollow.arbiter.layout import EVENT_NAMES

TOOLS = Path(__file__).parents[2] / "tools"
MS = 1_000_000
EPOCH = 7
FIRST, SECOND = EPOCH << 32 | 1, EPOCH << 32 | 2
# client 1 holds both resources, loses the robot's lease, comes back, client 2 takes over; one ends
HONEST = (
    (0, 0, "robot", 0, "NEW_EPOCH", "RESTART"),
    (0, 0, "robot", 0, "SAFE", "RESTART"),
    (0, 0, "camera", 0, "NEW_EPOCH", "RESTART"),
    (0, 0, "camera", 0, "SAFE", "RESTART"),
    (1, 1, "", 0, "ATTACH", ""),
    (2, 2, "", 0, "ATTACH", ""),
    (3, 1, "robot", FIRST, "GRANT", "REQUEST"),
    (4, 1, "camera", FIRST, "GRANT", "REQUEST"),
    (5, 1, "robot", FIRST, "FORWARD", "COMMAND"),
    (6, 2, "robot", 0, "DENY", "REQUEST"),
    (300, 1, "robot", FIRST, "REVOKE", "LEASE_OVER"),
    (300, 1, "robot", 0, "SAFE", "LEASE_OVER"),
    (301, 2, "robot", SECOND, "GRANT", "REQUEST"),
    (302, 2, "robot", SECOND, "FORWARD", "COMMAND"),
    (303, 1, "", 0, "LEASE_BACK", ""),
    (304, 1, "robot", FIRST, "REJECT_STALE_TOKEN", "COMMAND"),
    (305, 1, "camera", FIRST, "RELEASE", "RELINQUISH"),
    (305, 1, "camera", 0, "SAFE", "RELINQUISH"),
    (306, 1, "", 0, "DETACH", ""),
    (307, 2, "robot", SECOND, "FORWARD", "COMMAND"),
)


def honest() -> list[Entry]:
    return [
        Entry(k + 1, t * MS, client, resource, token, event, reason)
        for k, (t, client, resource, token, event, reason) in enumerate(HONEST)
    ]


def violations(entries: list[Entry], period_ns: int = 5 * MS, end_ns: int = 307 * MS) -> list[str]:
    state = AuditState()
    state.begin(EPOCH, period_ns)
    for e in entries:
        state.enter(e)
    state.end(end_ns)
    return state.violations


def at(event: str, nth: int = 0) -> int:
    return [k for k, row in enumerate(HONEST) if row[4] == event][nth]


def renumbered(entries: list[Entry]) -> list[Entry]:
    return [e._replace(seq=k + 1) for k, e in enumerate(entries)]


def without(event: str, nth: int = 0) -> Callable[[list[Entry]], list[Entry]]:
    return lambda es: renumbered(es[: at(event, nth)] + es[at(event, nth) + 1 :])


def changed(which: str, nth: int = 0, **fields: object) -> Callable[[list[Entry]], list[Entry]]:
    def forge(es: list[Entry]) -> list[Entry]:
        k = at(which, nth)
        es[k] = es[k]._replace(**fields)  # type: ignore[arg-type]
        return es

    return forge


FORGED = {
    "record cut out": (lambda es: es[:9] + es[10:], "is followed by record"),
    "record repeated": (lambda es: es[:9] + es[8:], "is followed by record"),
    "time goes back": (changed("DENY", t_ns=0), "time goes back"),
    "unknown event": (changed("DENY", event="PAINT"), "unknown event"),
    "token of another epoch": (changed("GRANT", 2, token=(EPOCH + 1) << 32), "not of epoch"),
    "token not higher": (changed("GRANT", 2, token=FIRST), "not higher"),
    "granted while held": (changed("GRANT", 2, resource="camera"), "granted while held"),
    "granted to nobody": (without("ATTACH", 1), "granted to nobody"),
    "epoch never began": (without("NEW_EPOCH"), "before the server's epoch"),
    "forwarded without a grant": (without("GRANT", 2), "does not hold"),
    "forwarded after the revocation": (
        changed("FORWARD", 1, client=1, token=FIRST),
        "lease is over|does not hold",
    ),
    "forwarded for a silent client": (
        changed("REJECT_STALE_TOKEN", event="FORWARD", resource="robot"),
        "does not hold",
    ),
    "granted to a silent client": (changed("GRANT", 2, client=1), "lease is over"),
    "no safe command": (without("SAFE", 2), "no safe command"),
    "late safe command": (
        lambda es: es[: at("SAFE", 2)] + [e._replace(t_ns=e.t_ns + 10_000 * MS) for e in es[at("SAFE", 2) :]],
        "no safe command",
    ),
    "revoked what was not held": (changed("RELEASE", token=SECOND), "not held"),
    "detached with a resource": (changed("DETACH", client=2), "still holds"),
    "acts after its end": (changed("FORWARD", 2, client=1, event="DENY"), "detached does something"),
}


def test_an_honest_history_of_two_resources_is_accepted() -> None:
    assert violations(honest()) == []


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_history_is_found(name: str) -> None:
    forge, says = FORGED[name]
    found = violations(forge(honest()), end_ns=20_000 * MS)
    assert found, f"{name}: nothing found"
    assert any(part in found[0] for part in says.split("|")), found


def test_a_safe_command_that_never_comes_is_found_at_the_end() -> None:
    cut = honest()[: at("REVOKE") + 1]
    assert violations(cut, end_ns=302 * MS) == []
    assert "to the end" in violations(cut, end_ns=400 * MS)[0]


def test_what_was_overwritten_before_it_was_read_accuses_no_client() -> None:
    for first in range(1, len(HONEST)):
        state = AuditState()
        state.begin(EPOCH, 5 * MS)
        state.skip()
        for e in honest()[first:]:
            state.enter(e)
        assert state.violations == [], f"read from record {first} on"


def test_every_event_that_the_server_knows_is_known_and_the_file_of_a_history_is_read(
    arbiter, tmp_path: Path
) -> None:
    assert {row[4] for row in HONEST} <= set(EVENT_NAMES.values())
    with attach(arbiter.name, "go") as go:
        robot, camera = go.resource("robot"), go.resource("camera")
        assert robot.request()
        assert camera.request()
        until(lambda: robot.command(0.1, 0.1) and arbiter.command("status")["resources"])
        robot.relinquish()
    state, follower = AuditState(), Follower(Path("/dev/shm") / f"{arbiter.name}.arbiter")
    follower.begin(state)
    assert until(lambda: follower.read(state) == 0 and state.counts["records"] > 0)
    assert state.violations == []
    assert state.counts["grants"] >= 2

    words = [sys.executable, "-m", "surffollow", "arbiter", "history", "--name", arbiter.name, "--json"]
    lines = subprocess.run([*words, "--last", "4000"], capture_output=True, text=True, check=True).stdout
    pipe = subprocess.PIPE
    with subprocess.Popen([*words, "--follow"], stdout=pipe, stderr=pipe) as watch:
        watch.stdout.readline()
        watch.send_signal(signal.SIGINT)
        assert watch.communicate(timeout=60)[1] == b""
    assert watch.returncode == 0, "Ctrl-C is its normal end"
    file = tmp_path / "history.jsonl"
    file.write_text(lines)
    assert audit_file(file).violations == []
    events = [json.loads(line) for line in lines.splitlines()]
    k = next(n for n, e in enumerate(events) if e["event"] == "GRANT")
    file.write_text("\n".join(json.dumps(e) for e in events[:k] + events[k + 1 :]))
    program = [sys.executable, str(TOOLS / "arbiter_audit.py"), "--file", str(file), "--json"]
    found = subprocess.run(program, capture_output=True, text=True)
    assert found.returncode == 1
    assert json.loads(found.stdout)["violations"]
