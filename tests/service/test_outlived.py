"""Clients that outlive the service: every call detects its end and follows it to a new start."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from running_service import POSE, Service, World, drive, until
from surffollow.client import Client, Observer
from surffollow.errors import NotRunningError
from surffollow.shm.layout_follow import POSE_STALE

Make = Callable[..., Service]
REGION = (0.0, 0.0, 0.1, 0.1)
SPOT = POSE[:2]


@pytest.fixture
def killable(make_service: Make) -> Iterator[Service]:
    """A service with a sensor over flat ground and a map, for one test to kill."""
    s = make_service(kind="simulated")
    s.world = World(s.name)
    try:
        yield s.start()
    finally:
        s.world.close()


def over(call: Callable[[], Any]) -> bool:
    """Whether a call says that the service ended."""
    try:
        call()
    except NotRunningError:
        return True
    return False


def start_with_other_memory(s: Service) -> None:
    """A new start after a purge: the board's parts lie elsewhere, and the map is a larger object."""
    text = s.config.read_text().replace("log_words = 65536", "log_words = 131072")
    s.config.write_text(text.replace("grids = 20000", "grids = 30000") + "\n[follow]\nrange_size = 7\n")
    s.start()


def make_map(client: Client) -> None:
    client.map_reset(REGION)
    drive(client, lambda: client.map_height(*SPOT) == client.map_height(*SPOT), what="a height")


def settle(client: Client) -> None:
    """Wait until no sample comes any more, the pose being stale, and all that came are in the map."""
    until(lambda: client.dev_vector().status & POSE_STALE, "a stale pose")
    until(lambda: (s := client.status())["map"]["applied"] == s["samples"], "an empty queue")


def test_client_that_only_posts_poses_learns_of_the_end_and_goes_on_after_it(
    killable: Service,
) -> None:
    """GIVEN a client that only sends poses WHEN the service is killed and purged THEN it raises; WHEN one
    starts THEN it is used.
    """
    with killable.attach() as sender:
        sender.ee_pos(POSE)
        killable.kill()
        until(lambda: over(lambda: sender.ee_pos(POSE)), "the end")
        assert over(lambda: sender.ee_pos(POSE)), "and again"
        assert killable.run("stop", "--purge").returncode == 0
        start_with_other_memory(killable)
        with killable.observe() as watcher:

            def taken() -> bool:
                over(lambda: sender.ee_pos(POSE))
                return watcher.status()["poses"] > 3

            until(taken, "poses taken by the new service")
            until(lambda: watcher.status()["main"]["pose_slot"] == sender.slot, "the pose is its own")


def test_client_that_only_posts_poses_goes_on_after_a_quick_restart(killable: Service) -> None:
    """GIVEN a client that only sends poses WHEN the service restarts at once THEN its poses are taken."""
    with killable.attach() as sender:
        sender.ee_pos(POSE)
        assert killable.terminate() == 0
        killable.start()
        with killable.observe() as watcher:
            drive(sender, lambda: watcher.status()["poses"] > 3, what="poses taken by the new service")
            sender.release_pose()
            until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose is free")


READS: dict[str, Callable[[Observer], Any]] = {
    "params": lambda o: o.params()["range_size"] == 7,
    "output": lambda o: (o.output() or {"t_ns": 0})["t_ns"] > 0,
    "alive": lambda o: o.alive(),
    "status": lambda o: o.status()["alive"],
    "raw_distance": lambda o: o.raw_distance() == o.raw_distance(),
    "map_height": lambda o: o.map_height(*SPOT) == o.map_height(*SPOT),
    "map_surface": lambda o: o.map_surface(*SPOT).known,
    "map_window": lambda o: o.map_window().current(),
    "map_changes": lambda o: len(o.map_changes().tiles) > 0,
}
REPORTED_BY_THE_END = ("params", "output")
REPORTED_BY_THE_PURGE = ("map_height", "map_surface", "map_window", "map_changes")


def test_each_way_to_read_alone_tells_the_end_and_follows_a_new_start(killable: Service) -> None:
    """GIVEN an observer per reading WHEN the service is killed, purged, started THEN each says so."""
    watchers = {name: killable.observe() for name in READS}
    with killable.attach() as client:
        make_map(client)
        settle(client)
        old = watchers["map_window"].map_window()
        assert old.current()
        held = [o.map_height(*SPOT) for o in watchers.values()]
        assert min(held) == max(held)
        killable.kill()
        for name in REPORTED_BY_THE_END:
            until(lambda name=name: over(lambda: READS[name](watchers[name])), f"{name} tells the end")
        for name in ("alive", "status", "raw_distance"):
            until(lambda name=name: not READS[name](watchers[name]), f"{name} tells the end")
        for name in REPORTED_BY_THE_PURGE:
            assert READS[name](watchers[name]), "the map outlives the service"
        assert killable.run("stop", "--purge").returncode == 0
        assert not old.current()
        for name in REPORTED_BY_THE_PURGE:
            until(lambda name=name: over(lambda: READS[name](watchers[name])), f"{name} tells the purge")
        start_with_other_memory(killable)
        with killable.attach() as robot:
            make_map(robot)
            for name, read in READS.items():
                drive(robot, lambda n=name, read=read: read(watchers[n]), what=f"{name} of the new service")
    for watcher in watchers.values():
        watcher.close()


def test_ticket_of_a_dead_service_is_done_and_says_so_at_once(killable: Service) -> None:
    """GIVEN a request that is under way WHEN the service is killed THEN its ticket is done and raises."""
    with killable.attach(stale_min_s=3.0) as client:  # the request is sent before that
        killable.freeze()
        ticket = client.sf_reset(0.1, wait=False)
        assert not ticket.done()
        killable.kill()
        until(ticket.done, "the end of the wait")
        with pytest.raises(NotRunningError, match="does not answer"):
            ticket.result(1e9)


def test_request_outlasts_a_stall_shorter_than_its_time(killable: Service) -> None:
    """GIVEN a service that stands still WHEN a request waits and the service goes on THEN the request is
    answered.
    """
    with killable.attach() as client, ThreadPoolExecutor(1) as asker:
        killable.freeze()
        until(lambda: not client.alive(), "silence")
        with pytest.raises(NotRunningError, match="does not answer"):
            client.sf_reset(0.1, timeout_s=0.05)
        with pytest.raises(NotRunningError, match="does not answer"):
            client.sf_reset(0.1, wait=False)
        looks = client._next_attach_ns
        asked = asker.submit(client.sf_reset, 0.1, timeout_s=60.0)
        until(lambda: client._next_attach_ns > looks, "the asker's look for a service")
        assert not asked.done()
        killable.send(signal.SIGCONT)
        assert asked.result(60.0).done()


def test_service_that_only_stands_still_is_not_taken_for_dead(killable: Service) -> None:
    """GIVEN a client WHEN its service stands still THEN readings hold; WHEN it goes on, poses are taken."""
    with killable.attach() as client:
        client.ee_pos(POSE)
        killable.freeze()
        until(lambda: not client.alive(), "silence")
        for _ in range(3):
            client._next_look_ns = client._next_attach_ns = 0
            client.ee_pos(POSE)
            client._next_attach_ns = 0
            assert client.params()["range_size"] == 5
            assert client.output() is not None
        killable.send(signal.SIGCONT)
        before = client.status()["poses"]
        drive(client, lambda: client.status()["poses"] > before + 3, what="poses")
