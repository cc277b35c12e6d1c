"""Deaths, stops and restarts of either side: silence is reported, demands become zero, then recovery."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable

import pytest

from running_service import POSE, Service, drive, program, said, until
from service.pose_senders import SENDER
from surffollow.cli.status import render
from surffollow.client import DEMAND_BYTES, STALE, Client
from surffollow.client.demand import VALID
from surffollow.errors import NotRunningError
from surffollow.shm.layout_follow import POSE_STALE

Make = Callable[..., Service]
REGION = (0.0, 0.0, 0.1, 0.1)
ZERO = [0.0] * 6


@pytest.mark.parametrize("periods", [20, 100])
def test_a_killed_service_is_stale_after_the_configured_periods_and_demands_zero(
    make_service: Make, periods: int
) -> None:
    """GIVEN an observer of a service WHEN the service is killed THEN its demand is zero and STALE after the
    periods asked for.
    """
    s = make_service().start()
    with s.observe(stale_periods=periods) as watcher:
        until(lambda: not watcher.dev_vector().status & STALE, "a fresh demand")
        s.kill()
        killed_ns, fresh = time.monotonic_ns(), []
        while not (demand := watcher.dev_vector()).status & STALE:
            fresh.append(demand.age_ns)
            assert time.monotonic_ns() - killed_ns < 10e9
        assert max(fresh, default=0) <= periods * 1_000_000 < demand.age_ns
        assert list(demand) == ZERO
        assert not demand.valid
        assert "STALE" in demand.names
        assert watcher.raw_distance() != watcher.raw_distance(), "NaN"
        status = watcher.status()
        assert (status["alive"], status["state"], status["process_runs"]) == (False, "stale", False)
        done = s.run("status", "--json")
        assert done.returncode == 1
        assert json.loads(done.stdout)["state"] == "stale"
        first = s.run("status").stdout.splitlines()[0]
        remedy = f"its process has ended: surffollow start --name {s.name}"
        assert first.endswith(f"{remedy}; the lines below are what it published last")


def test_a_client_that_knows_of_the_end_gives_no_demand_however_new_it_is(make_service: Make) -> None:
    # GIVEN a client for which a demand is stale after an hour only
    s = make_service().start()
    with s.attach(stale_min_s=3600.0) as client:
        until(lambda: sent(client) and not client.dev_vector().status & STALE, "a fresh demand")
        # WHEN the service is killed and a call says so
        s.kill()
        until(lambda: not sent(client), "the end")
        # THEN the demand is stale and zero
        assert client.dev_vector().status & STALE
        assert list(client.dev_vector()) == ZERO
        assert not client.dev_vector_into(bytearray(DEMAND_BYTES))
        # WHEN it is started again, THEN the client follows
        s.start()
        until(lambda: sent(client) and not client.dev_vector().status & STALE, "a fresh demand")


def sent(client: Client) -> bool:
    """Whether a pose was sent; False: the service does not run."""
    try:
        client.ee_pos(POSE)
    except NotRunningError:
        return False
    return True


def test_clients_follow_a_killed_and_restarted_service_by_themselves(make_service: Make) -> None:
    # GIVEN a client that drives with a parameter of its own, and an observer
    s = make_service().start()
    with s.attach() as client, s.observe() as watcher:
        client.ee_pos(POSE)
        client.set_params(range_size=7)
        old = client.epoch
        # WHEN the service is killed THEN requests are refused
        s.kill()
        until(lambda: not client.alive(), "silence")
        with pytest.raises(NotRunningError):
            client.sf_reset(0.1)
        # WHEN it is started again THEN both are attached to it, and it has the configuration's parameters
        s.start()
        until(lambda: client.alive() and watcher.alive(), "re-attachment")
        assert client.epoch == watcher.epoch > old
        drive(client, lambda: client.status()["poses"] > 5, what="poses taken by the new service")
        client.sf_reset(0.11)
        client.map_reset(REGION)
        assert client.params()["offset_m"] == 0.11
        assert client.params()["range_size"] == 5, "parameters come from the configuration again"


def test_a_request_that_is_under_way_when_the_service_dies_says_so(make_service: Make) -> None:
    s = make_service().start()
    with s.attach(stale_min_s=3.0) as client:  # the request is sent before that
        # GIVEN a request that a service which stands still has not answered
        s.freeze()
        ticket = client.sf_reset(0.1, wait=False)
        # WHEN that service dies THEN the ticket says so, also after the next start
        s.kill()
        with pytest.raises(NotRunningError, match="does not answer"):
            ticket.result(10.0)
        s.start()
        until(client.alive, "re-attachment")
        with pytest.raises(NotRunningError, match="restarted"):
            ticket.result(1.0)


def test_a_stopped_and_continued_service_recovers_and_keeps_its_clients(make_service: Make) -> None:
    """GIVEN a client WHEN its service stands still and goes on, twice THEN it is stale and afterwards takes
    poses again.
    """
    s = make_service().start()
    with s.attach() as client:
        client.ee_pos(POSE)
        epoch = client.epoch
        for _ in range(2):
            s.freeze()
            until(lambda: not client.alive(), "silence")
            assert list(client.dev_vector()) == ZERO
            status = client.status()
            assert (status["state"], status["process_runs"]) == ("stale", True)
            assert f"its process stands still: kill -CONT {status['pid']} where" in render(status)
            s.send(signal.SIGCONT)
            before = client.status()["poses"]
            drive(client, lambda before=before: client.status()["poses"] > before + 3, what="poses")
            client.sf_reset(0.1)
        assert client.epoch == epoch, "the same start"


def test_a_stopped_and_continued_client_goes_on_where_it_was(service: Service) -> None:
    """GIVEN a program that sends poses WHEN it stands still THEN the pose is stale; WHEN it goes on THEN
    demands are valid.
    """
    with service.observe() as watcher, program(SENDER, service.name) as sender:
        said(sender)
        until(lambda: watcher.dev_vector().status & VALID, "a demand")
        sender.send_signal(signal.SIGSTOP)
        stale = until(lambda: (d := watcher.dev_vector()).status & POSE_STALE and d, "POSE_STALE")
        assert list(stale) == ZERO
        assert not stale.valid
        cycles = watcher.status()["cycles"]
        until(lambda: watcher.status()["cycles"] > cycles + 100, "the service goes on")
        sender.send_signal(signal.SIGCONT)
        until(lambda: watcher.dev_vector().status & VALID, "a demand again")
        until(lambda: watcher.status()["main"]["pose_pid"] == sender.pid, "the pose is still its own")


def test_a_killed_client_leaves_a_zero_demand_and_a_free_slot(service: Service) -> None:
    """GIVEN a program that sends poses WHEN it is killed THEN the demand is zero, pose and slot are free."""
    with service.observe() as watcher, program(SENDER, service.name) as sender:
        slot = int(said(sender).split()[1])
        until(lambda: watcher.dev_vector().status & VALID, "a demand")
        sender.kill()
        sender.wait()
        stale = until(lambda: (d := watcher.dev_vector()).status & POSE_STALE and d, "POSE_STALE")
        assert list(stale) == ZERO
        until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose is free")
        with service.attach() as heir:
            assert heir.slot in (slot, slot + 1), "the slot is used again, or retired a moment ago"


def test_a_client_that_died_while_writing_leaves_no_half_pose(service: Service) -> None:
    """GIVEN a pose that is half written WHEN the service runs on THEN it takes nothing of it."""
    with service.attach() as client:
        drive(client, lambda: client.dev_vector().status & VALID, what="a demand")
        before = client.status()
        # the payload of the next generation is half written, its generation never published
        g = client._in_words[client._pose_index] + 1
        at = client._pose_base + (g & 3) * 64
        client._in[at : at + 30] = b"\xff" * 30
        service.cycles(20)
        after = client.status()
        assert (after["poses_refused"], after["torn"]) == (before["poses_refused"], before["torn"])
        assert client.output()["t_ns"] > 0
        drive(client, lambda: client.status()["poses"] > before["poses"] + 3, what="poses")


@pytest.mark.parametrize("policy", ["skip", "catch-up"])
def test_overruns_are_skipped_or_caught_up_as_the_policy_says(make_service: Make, policy: str) -> None:
    s = make_service(realtime=f'overrun = "{policy}"').start()
    with s.observe() as watcher:
        before = watcher.status()
        s.freeze()
        until(lambda: watcher.dev_vector().age_ns > 200_000_000, "200 ms of silence")
        s.send(signal.SIGCONT)
        start_ns = time.monotonic_ns()
        until(lambda: watcher.dev_vector().age_ns < 2_000_000, "the service goes on")
        s.cycles(300)
        after = watcher.status()
        assert time.monotonic_ns() - start_ns < 10e9
    missed = after["skipped"] - before["skipped"]
    late = after["overruns"] - before["overruns"]
    if policy == "skip":
        assert missed >= 190
        assert late < missed
    else:
        assert missed == 0
        assert late >= 190
    assert after["lateness"]["max_ns"] > 150_000_000
