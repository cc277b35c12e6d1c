"""Death and restart of the service, seen from C: stale, zero, and attached again without help."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest

from cabi.running import Probe, Service, StillWorld
from surffollow.client import STALE
from surffollow.shm.layout_follow import VALID

OK = 0
SILENCE_NS = 20_000_000
POSE = "ee 0.05 0.05 0.1 0 0 0 1"


@pytest.fixture(scope="module")
def own_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service of this module's own, not started, with something to see for its sensor."""
    s = Service(f"cabi-own-{os.getpid()}", tmp_path_factory.mktemp("mortal"))
    world = StillWorld(s.name)
    try:
        yield s
    finally:
        s.stop()
        world.close()


@pytest.fixture
def mortal(own_service: Service) -> Service:
    """A living service that a test may kill; the next test starts it again."""
    if own_service.process is None or own_service.process.poll() is not None:
        own_service.start()
    return own_service


def test_client_follows_a_killed_service_into_its_next_life(
    mortal: Service, make_probe: Callable[..., Probe]
) -> None:
    probe, watcher, fixed = make_probe(), make_probe(), make_probe()
    fixed("auto 0")
    for p, how in ((probe, "attach"), (watcher, "observe"), (fixed, "attach")):
        assert p(f"{how} {mortal.name}").result == OK
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    probe.until(POSE, lambda a: int(probe("dev").values[2]) & VALID != 0)
    probe.until(POSE, lambda a: probe("height 0.05 0.05").result == OK)
    epoch = int(probe("dev").values[3])

    mortal.kill()
    for p in (probe, watcher, fixed):
        fresh = [0.0]
        silent = p.until("dev", lambda a, f=fresh: bool(int(a.values[2]) & STALE or f.append(a.values[4])))
        assert max(fresh) <= SILENCE_NS < silent.values[4], "20 periods of 1 ms"
        assert silent.values[:2] == [0.0, 0.0]
        assert not int(silent.values[2]) & VALID
    assert probe("reset 0.1").result == -20
    assert probe("begin 50").result == -20

    mortal.start()
    for p in (probe, watcher):
        p.until("dev", lambda a: int(a.values[3]) > epoch and not int(a.values[2]) & STALE)
    # this one was told not to look by itself
    assert int(fixed("dev").values[2]) & STALE
    assert fixed("reset 0.1").result == -20
    assert fixed("reattach").result == OK
    assert fixed("alive").result == 1
    # the pose is claimed anew, the map was kept
    assert probe(POSE).result == OK
    assert probe("reset 0.1").result == OK
    assert probe("height 0.05 0.05").result == OK
    assert fixed("reset 0.1").result == OK


def test_holder_is_told_that_the_service_was_restarted(
    mortal: Service, make_probe: Callable[..., Probe]
) -> None:
    for how in ("auto 0", "auto 1"):
        probe = make_probe()
        probe(how)
        assert probe(f"attach {mortal.name}").result == OK
        assert probe("begin 1000").result == OK
        mortal.kill()
        mortal.start()
        assert probe("end").result == -31
        probe.until("reattach", lambda a: a.result == OK)
        assert probe("holding 1000 0").result == OK


def test_purged_map_is_found_again_when_it_is_made_anew(
    mortal: Service, make_probe: Callable[..., Probe]
) -> None:
    probe = make_probe()
    probe(f"attach {mortal.name}")
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    probe.until(POSE, lambda a: probe("height 0.05 0.05").result == OK)
    mortal.stop()
    mortal.start()
    probe.until("dev", lambda a: not int(a.values[2]) & STALE)
    assert probe("height 0.05 0.05").result == 4
    assert probe("map_reset 0 0 0.1 0.1").result == OK


def test_attaching_to_what_a_killed_service_left_is_safe(
    mortal: Service, make_probe: Callable[..., Probe]
) -> None:
    mortal.kill()
    probe = make_probe()
    assert probe(f"attach {mortal.name}").result == OK
    probe.until("alive", lambda a: a.result == 0)
    assert probe(POSE).result == -20
    assert probe("status").values[0] == 0
    assert probe("upload /dev/null/x").result == -20
    assert os.path.exists(f"/dev/shm/{mortal.name}.map")
