"""The audit trail under attack: nothing that a client does hides a change, on the board or in the log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from running_service import Service, until
from surffollow.client import attach
from surffollow.client.audit import read_audit
from surffollow.errors import RefusedError
from surffollow.service import memory as m
from surffollow.service.audit import BURST, CHANGED, KEPT, REFUSED, AuditTrail
from surffollow.service.client_table import NAMES
from surffollow.shm import layout_board as lb
from surffollow.shm.dtypes import numpy_dtype
from surffollow.shm.layout_follow import STOP_DRIVER, STOP_RESTART, STOP_START, Params

Make = Callable[..., Service]
MAX_DEMAND = Params.offset("max_demand_m") // 8
PARAMS = [f.offset // 8 for f in Params.FIELDS]
SECOND = 1_000_000_000
BURST_OF_CHANGES = round(BURST[CHANGED])


class Trail:
    """An audit trail on a board of a test's own; `lines`: reported lines, and whether each may be dropped."""

    def __init__(self) -> None:
        board = np.zeros((lb.LogHead.SIZE // 8) + lb.AUDIT_WORDS, np.uint64)
        board[lb.LogHead.offset("capacity") // 8] = lb.AUDIT_WORDS
        self.board = SimpleNamespace(
            regions={"audit": (0, board.nbytes)}, words=memoryview(board), memory=memoryview(board).cast("B")
        )
        objects: Any = SimpleNamespace(address=lambda part: board.ctypes.data)
        self.ctx = np.zeros(m.CTX_WORDS, np.int64)
        self.lines: list[tuple[str, bool]] = []
        self.takes = True
        self.trail = AuditTrail(objects, self.ctx, lambda claim: "mallory", self._report)
        self.now_ns = 10 * SECOND

    def _report(self, line: str, *, limited: bool) -> bool:
        self.lines.append((line, limited))
        return self.takes

    def ask(self, code: int, *, result: int = lb.OK, uid: int = 65534, pid: int = 7, **fields: Any) -> None:
        """One entry, as the cycle queues it, a millisecond after the one before."""
        self.now_ns += 1_000_000
        entry: Any = np.zeros(1, numpy_dtype(lb.AuditEntry))
        e = entry[0]
        e["t_ns"], e["code"], e["result"], e["uid"], e["pid"] = self.now_ns, code, result, uid, pid
        e["count"], e["word"], e["slot"], e["claim"] = 1, -1, 3, self.now_ns
        for name, value in fields.items():
            e[name] = value
        self.trail._take(entry, self.now_ns)

    def shown(self) -> list[dict[str, Any]]:
        return read_audit(self.board)  # type: ignore[arg-type]


@pytest.fixture
def trail() -> Trail:
    return Trail()


def change(trail: Trail, old: float, new: float, **fields: Any) -> None:
    trail.ask(lb.RQ_SET_PARAMS, word=MAX_DEMAND, old_value=old, new_value=new, **fields)


def test_refusals_with_ever_new_numbers_processes_and_claims_are_few_entries(trail: Trail) -> None:
    for k in range(3000):
        trail.ask(10**6 + k, result=lb.ERR_UNKNOWN_REQUEST, pid=k, word=k, claim=k)
    assert len(trail.shown()) <= BURST[REFUSED] + 4, "sixteen at once, one a second"
    assert len(trail.lines) <= BURST[REFUSED] + 4
    assert len(trail.trail._gathered) <= 1, "what waits is bounded, too"
    trail.ask(10**6, result=lb.ERR_UNKNOWN_REQUEST, uid=65533)
    assert trail.shown()[-1]["uid"] == 65533, "another user has a share of his own"


@pytest.mark.parametrize("code", [lb.RQ_CLAIM_POSE, lb.RQ_RELEASE_POSE, lb.RQ_MAP_RESET])
def test_what_is_granted_again_and_again_displaces_no_change(trail: Trail, code: int) -> None:
    change(trail, 0.05, 1000.0)
    for k in range(2000):
        trail.ask(code, result=lb.ACCEPTED, pid=k)
        trail.ask(-k, result=lb.ERR_UNKNOWN_REQUEST, uid=k)  # as many users as one likes
    assert [e["new"] for e in trail.shown() if e["parameter"]] == [1000.0]
    times = [e["t_ns"] for e in trail.shown()]
    assert times == sorted(times)
    assert len(set(times)) == len(times), "each is shown once"
    assert sum("-> 1000" in line for line, _ in trail.lines) == 1, "and told once"


def test_only_later_changes_displace_a_change_and_slowly(trail: Trail) -> None:
    change(trail, 0.05, 1000.0, uid=1)
    for k in range(4 * KEPT):
        change(trail, 1000.0 + k, 1001.0 + k)
    mine = [e for e in trail.shown() if e["uid"] == 65534]
    assert len(mine) <= BURST[CHANGED] + 2
    assert any(e["uid"] == 1 for e in trail.shown())


def test_changes_beyond_the_budget_are_reported_as_one_from_the_first_value_to_the_last(trail: Trail) -> None:
    n = int(BURST[CHANGED])
    for k in range(n + 50):
        change(trail, float(k), k + 1.0)
    assert len(trail.shown()) == n
    trail.trail._gathered[next(iter(trail.trail._gathered))].since_ns = 0
    trail.trail._budgets[65534, CHANGED].left = 1.0
    trail.trail.publish()
    last = trail.shown()[-1]
    assert (last["old"], last["new"], last["count"]) == (n, n + 50.0, 50)
    assert not trail.trail._gathered


def test_a_client_that_drives_cannot_flush_the_trail_with_every_parameter(trail: Trail) -> None:
    change(trail, 0.05, 1000.0, uid=1)
    for k in range(20):
        for word in PARAMS:
            trail.ask(lb.RQ_SET_PARAMS, word=word, new_value=float(k))
    assert any(e["uid"] == 1 for e in trail.shown())
    assert len(trail.trail._gathered) <= len(PARAMS), "what waits is bounded"


def test_lines_of_changes_have_no_rate_and_every_line_that_is_dropped_is_counted(trail: Trail) -> None:
    change(trail, 0.05, 1000.0)
    trail.ask(5, result=lb.ERR_UNKNOWN_REQUEST)
    assert [limited for _, limited in trail.lines] == [False, True]
    assert trail.trail.lost == 0
    trail.takes = False
    change(trail, 1000.0, 0.05)
    trail.ask(5, result=lb.ERR_UNKNOWN_REQUEST)
    assert trail.trail.lost == 2


def test_a_stop_for_the_driver_has_its_newest_fault_as_the_reason_also_when_that_is_over(
    trail: Trail,
) -> None:
    trail.trail.publish("port: not there")
    trail.trail.publish()
    trail.ask(lb.RQ_STOP, slot=-1, detail=STOP_DRIVER)
    trail.trail.publish("port: " + "é" * 100)
    trail.ask(lb.RQ_STOP, slot=-1, detail=STOP_DRIVER | STOP_START)
    trail.ask(lb.RQ_STOP, slot=-1, detail=STOP_START)
    reasons = [e["reason"] for e in trail.shown()]
    assert reasons[0] == "port: not there"
    assert reasons[1] == "port: " + "é" * 27 + "…"
    assert reasons[2] == ""
    assert trail.lines[0][0].endswith('service: stop (driver) "port: not there": ok')


def test_a_stop_from_before_the_start_says_so(trail: Trail) -> None:
    trail.trail.note_start(STOP_DRIVER)
    trail.trail.note_start(STOP_START | STOP_RESTART)
    assert [e["reason"] for e in trail.shown()] == ["kept from before this start", ""]


def test_a_change_between_two_floods_is_on_the_board_and_in_the_log(
    make_service: Make, tmp_path: Path
) -> None:
    s, log = make_service(), tmp_path / "log"
    s.start_logged(log)
    with s.attach(label="mallory") as client:
        client.claim_pose()

        def flood(first: int) -> None:
            for n in range(450):
                with pytest.raises(RefusedError):
                    client._request(first + n, patience_s=1.0).result(5.0)
            for _ in range(20):
                client.stop("x")

        flood(10**6)
        client.set_params(max_demand="1000 m", max_speed=1000.0)
        flood(2 * 10**6)
        until(lambda: any(e["new"] == 1000.0 for e in client.audit()), "the change on the board")
        flood(3 * 10**6)
        until(lambda: "max_demand_m" in log.read_text(), "the change in the log")
        assert {e["parameter"] for e in client.audit() if e["accepted"]} >= {"max_demand_m", "max_speed_mps"}
        assert "max_speed_mps" in log.read_text()
        assert client.status()["main"]["audit_lost"] == 0


def test_the_end_leaves_nothing_untold(trail: Trail) -> None:
    for k in range(BURST_OF_CHANGES + 9):
        change(trail, 0.01 * k, 0.01 * (k + 1))
    trail.trail.finish()
    assert trail.shown()[-1]["new"] == pytest.approx(0.01 * (BURST_OF_CHANGES + 9))
    assert not trail.trail._gathered
    assert sum("max_demand" in line for line, _ in trail.lines) == BURST_OF_CHANGES + 1


def test_a_change_and_a_stop_just_before_the_end_are_in_the_log(make_service: Make) -> None:
    s = make_service().start()
    with s.attach(label="late") as client:
        client.claim_pose()
        for k in range(BURST_OF_CHANGES + 6):
            client.set_params(max_demand=0.01 + 1e-4 * k)
        client.set_params(max_demand=0.04321)
        client.stop("because")
        process = s.process
        assert process is not None
        process.terminate()
        _, log = process.communicate(timeout=60.0)
        s.process = None
    assert "0.04321" in log
    assert "because" in log


def test_who_holds_a_slot_keeps_his_name_in_the_trail_whoever_comes_and_goes(make_service: Make) -> None:
    with make_service().start().attach(label="THE-DRIVER") as driver:
        driver.claim_pose()
        name = driver.name
        for _ in range(NAMES + 5):
            attach(name, stale_min_s=1.0, label="x").close()
        driver.set_params(max_demand=0.0432)
        last = until(lambda: [e for e in driver.audit() if e["new"] == 0.0432], "the entry")[-1]
        assert last["client"] == "THE-DRIVER"
