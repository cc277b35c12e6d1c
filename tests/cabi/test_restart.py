"""Death and restart of the service, seen from C: stale, zero, and attached again without help."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable

import pytest

from cabi.running import Probe
from hanging_socket import MANNERS, hanging
from running_service import Service
from surffollow.client import STALE
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import VALID

OK, NOT_RUNNING = 0, -20
NO_DEMAND = 1
SILENCE_NS = 20_000_000
POSE = "ee 0.05 0.05 0.1 0 0 0 1"


def test_client_of_a_killed_service_attaches_again_after_its_next_start(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN a client that drives, an observer, and a client that does not attach again by itself
    probe, watcher, fixed = (make_probe(stale_ms=0) for _ in range(3))
    fixed("auto 0")
    for p, how in ((probe, "attach"), (watcher, "observe"), (fixed, "attach")):
        assert p(f"{how} {killable.name}").result == OK
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    probe.until(POSE, lambda a: int(probe("dev").values[2]) & VALID != 0)
    probe.until(POSE, lambda a: probe("height 0.05 0.05").result == OK)
    epoch = int(probe("dev").values[3])
    # WHEN the service is killed
    killable.kill()
    # THEN each is told after 20 periods, demands are zero, and every request is refused
    for p in (probe, watcher, fixed):
        fresh = [0.0]
        silent = p.until("dev", lambda a, f=fresh: bool(int(a.values[2]) & STALE or f.append(a.values[4])))
        assert max(fresh) <= SILENCE_NS < silent.values[4], "20 periods of 1 ms"
        assert silent.values[:2] == [0.0, 0.0]
        assert not int(silent.values[2]) & VALID
    assert probe("reset 0.1").result == -20
    assert probe("begin 50").result == -20
    # WHEN it is started again
    killable.start()
    # THEN two follow it by themselves and the third when it is told to
    for p in (probe, watcher):
        p.until("dev", lambda a: int(a.values[3]) > epoch and not int(a.values[2]) & STALE)
    # this one was told not to look by itself
    assert int(fixed("dev").values[2]) & STALE
    assert fixed("reset 0.1").result == -20
    assert fixed("reattach").result == OK
    fixed.until("alive", lambda a: a.result == 1)
    # the pose is claimed anew, the map was kept
    probe.until(POSE, lambda a: a.result == OK)
    assert probe("reset 0.1").result == OK
    assert probe("height 0.05 0.05").result == OK
    # the pose is the other client's, and so are settings and map
    assert fixed("map_reset 0 0 0.1 0.1").result == -100 - lb.ERR_NOT_POSE_HOLDER
    assert probe("map_reset 0 0 0.1 0.1").result == OK


def test_holder_learns_that_the_service_was_restarted(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    for how in ("auto 0", "auto 1"):
        # GIVEN a C client that holds the map
        probe = make_probe()
        probe(how)
        assert probe(f"attach {killable.name}").result == OK
        assert probe("begin 60000").result == OK
        # WHEN the service is killed and started again
        killable.kill()
        killable.start()
        # THEN the end of the access says so, and the client may take the map again
        assert probe("end").result == -31
        probe.until("reattach", lambda a: a.result == OK)
        assert probe("holding 60000 0").result == OK


def test_purged_map_is_found_again_when_it_is_made_anew(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN a C client that reads the map
    probe = make_probe()
    probe(f"attach {killable.name}")
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    probe.until(POSE, lambda a: probe("height 0.05 0.05").result == OK)
    # WHEN the service ends, its map is removed, and it starts again
    killable.stop()
    probe.until("dev", lambda a: bool(int(a.values[2]) & STALE))  # it is seen to have ended
    killable.start()
    probe.until("dev", lambda a: not int(a.values[2]) & STALE)
    # THEN the new map is empty, and may be laid
    assert probe("height 0.05 0.05").result == 4
    assert probe("map_reset 0 0 0.1 0.1").result == OK


def test_attaching_to_what_a_killed_service_left_is_safe(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN what a killed service left
    killable.kill()
    # WHEN a C client attaches or observes, THEN the error is that no service is there
    probe = make_probe()
    probe("ready_ms 100")
    assert probe(f"attach {killable.name}").result == NOT_RUNNING
    assert probe(f"observe {killable.name}").result == OK
    probe.until("alive", lambda a: a.result == 0)
    assert probe(POSE).result == -26
    assert probe("status").values[0] == 0
    assert probe("upload /dev/null/x").result == -26
    assert os.path.exists(f"/dev/shm/{killable.name}.map")


def start_with_other_memory(service: Service) -> None:
    """A new start: the board's parts lie elsewhere, and the map is another object."""
    service.stop()
    text = service.config.read_text()
    words = "131072" if "log_words = 65536" in text else "65536"
    service.config.write_text(re.sub(r"log_words = \d+", f"log_words = {words}", text))
    service.start()


def test_client_that_only_posts_poses_learns_of_the_end_and_goes_on_after_it(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN clients that post poses
    probe, fixed, watcher = make_probe(), make_probe(), make_probe()
    fixed("auto 0")
    for p, how in ((probe, "attach"), (fixed, "attach"), (watcher, "observe")):
        assert p(f"{how} {killable.name}").result == OK
    assert probe(POSE).result == OK
    # WHEN the service is killed
    killable.kill()
    # THEN every pose is refused until it is started again, elsewhere in memory
    probe.until(POSE, lambda a: a.result == NOT_RUNNING)
    assert probe(POSE).result == NOT_RUNNING
    # WHEN it is started again, THEN poses go on, or after `reattach` where a client is told to wait
    start_with_other_memory(killable)
    probe.until(POSE, lambda a: a.result in (OK, NOT_RUNNING) and watcher("status").values[6] > 3)
    assert fixed(POSE).result == NOT_RUNNING, "told not to look by itself"
    assert probe("release").result == OK
    assert fixed("reattach").result == OK
    fixed.until(POSE, lambda a: a.result == OK)


def test_each_way_to_read_alone_tells_the_end_and_follows_a_new_start(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN a probe for each way to read, and a map
    ended = ("get range_size", "params", "output")
    purged = ("height 0.05 0.05", "surface 0.05 0.05")
    silent = {"alive": 0, "raw 0": 3}
    reads = {line: make_probe() for line in (*ended, *purged, *silent, "status")}
    robot = make_probe()
    for p in reads.values():
        assert p(f"observe {killable.name}").result == OK
    assert robot(f"attach {killable.name}").result == OK
    assert robot("map_reset 0 0 0.1 0.1").result == OK
    robot.until(POSE, lambda a: robot("height 0.05 0.05").result == OK)
    robot.until(POSE, lambda a: reads["raw 0"]("raw 0").result == OK)
    for line in (*ended, *purged):
        assert reads[line](line).result == OK, line
    # WHEN the service is killed THEN all but the map's readers are told
    killable.kill()
    for line in ended:
        reads[line].until(line, lambda a: a.result == NOT_RUNNING)
    for line, result in silent.items():
        reads[line].until(line, lambda a, result=result: a.result == result)
    reads["status"].until("status", lambda a: a.values[0] == 0)
    for line in purged:
        assert reads[line](line).result == OK, "the map outlives the service"
    # WHEN the map is removed THEN its readers are told, too
    killable.stop()
    for line in purged:
        reads[line].until(line, lambda a: a.result == NOT_RUNNING)
    # WHEN another service starts under the name THEN each of them follows it
    start_with_other_memory(killable)
    new = make_probe()
    assert new(f"attach {killable.name}").result == OK
    assert new("map_reset 0 0 0.1 0.1").result == OK
    new.until(POSE, lambda a: new("height 0.05 0.05").result == OK)
    for line in (*ended, *purged):
        reads[line].until(line, lambda a: a.result == OK)
    reads["alive"].until("alive", lambda a: a.result == 1)
    reads["status"].until("status", lambda a: a.values[0] == 1)
    new.until(POSE, lambda a: reads["raw 0"]("raw 0").result == OK)


def test_poll_of_a_dead_services_answer_says_so(killable: Service, make_probe: Callable[..., Probe]) -> None:
    # GIVEN a request to a service that stands still
    probe = make_probe(stale_ms=2000)  # the request is sent before that
    assert probe(f"attach {killable.name}").result == OK
    killable.freeze()
    assert probe("send 1 0.1").result == OK
    # THEN its answer is to come
    assert probe("poll").result == 2
    probe.until("alive", lambda a: a.result == 0)
    assert probe("poll").result == 2, "it only stands still"
    assert probe("get range_size").result == OK
    # WHEN the service is killed, THEN there will be none
    killable.kill()
    probe.until("poll", lambda a: a.result == NOT_RUNNING)
    assert probe("wait 1000000").result == NOT_RUNNING, "at once"
    # WHEN it is started again, THEN the request is lost
    killable.start()
    probe.until("poll", lambda a: a.result == -28)


@pytest.mark.parametrize("manner", MANNERS)
def test_no_call_of_a_control_loop_waits_for_a_socket_that_hangs(
    killable: Service, make_probe: Callable[..., Probe], manner: str
) -> None:
    # GIVEN a client that drives
    probe = make_probe()
    assert probe(f"attach {killable.name}").result == OK
    probe.until(POSE, lambda a: a.result == OK)
    # WHEN the service is started again and its socket hangs
    killable.kill()
    probe.until(POSE, lambda a: a.result == NOT_RUNNING)
    killable.start()
    with hanging(killable.name, manner):
        # THEN no call waits for it
        slow = 0
        for _ in range(100):
            began = time.monotonic()
            assert probe(POSE).result == NOT_RUNNING
            probe("dev")
            slow += time.monotonic() - began > 0.1
        assert slow < 10, "one waiting exchange takes a second"
    # THEN poses go on when the socket does
    probe.until(POSE, lambda a: a.result == OK)


def test_a_client_that_knows_of_the_end_gives_no_demand_however_new_it_is(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    # GIVEN clients for which a demand is stale after an hour only
    probe, fixed = (make_probe(stale_ms=3_600_000) for _ in range(2))
    fixed("auto 0")
    for p in (probe, fixed):
        assert p(f"attach {killable.name}").result == OK
    for p in (fixed, probe):
        p.until(POSE, lambda a: a.result == OK)
        p.until("dev", lambda a: not int(a.values[2]) & STALE)
        p("release")
    probe.until(POSE, lambda a: a.result == OK)
    # WHEN the service is killed and a call says so
    killable.kill()
    for p in (probe, fixed):
        p.until(POSE, lambda a: a.result == -20)
        # THEN the demand is stale and zero
        demand = p("dev")
        assert demand.result == NO_DEMAND
        assert int(demand.values[2]) & STALE
        assert demand.values[:2] == [0.0, 0.0]
    # WHEN it is started again, THEN the first client follows
    killable.start()
    probe.until(POSE, lambda a: a.result == OK)
    probe.until("dev", lambda a: not int(a.values[2]) & STALE)
