"""The follower as one client of a shared tool: its demands bring the pose that they are relative to."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time

import pytest

from arbiter.arbiter_process import ArbiterProcess
from running_service import run_command, until
from surffollow.apps import shared_tool
from surffollow.apps.run_by_holder import RunByHolder
from surffollow.apps.shared_demo import arbiter_text
from surffollow.apps.shared_tool import RECENT, ReportedPoses, attach_arbitrated, follow
from surffollow.arbiter import Resource, attach, command_reader
from surffollow.client import attach as attach_service
from surffollow.errors import NotRunningError, RequestTimeoutError, UsageError

POSE = (0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0)


def test_the_newest_poses_are_found_by_their_timestamps(service, shared):
    """GIVEN a robot that reported more poses than are kept THEN all that are kept are found at once."""
    with ReportedPoses(shared.name) as poses:
        assert poses.at(1) is None
        robot = attach_arbitrated(service.name, shared.name, "tool")
        robot.claim_pose()
        now_ns = time.monotonic_ns()
        robot.ee_pos(POSE, now_ns - 1)
        assert until(lambda: poses.at(now_ns - 1)) == POSE
        assert poses.at(0) is None, "a slot that is empty"
        stamps = [now_ns + k for k in range(RECENT + 3)]
        for k, t_ns in enumerate(stamps):
            robot.ee_pos((1e-3 * k, *POSE[1:]), t_ns)
        until(lambda: poses.at(stamps[-1]))
        kept = [(1e-3 * k, *POSE[1:]) for k in range(3, RECENT + 3)]
        assert [poses.at(t_ns) for t_ns in stamps[3:]] == kept
        assert [poses.at(t_ns) for t_ns in (0, *stamps[:3])] == [None] * 4
        robot.close()


@pytest.mark.parametrize("combine", ["priority", "sum"])
def test_the_demonstration_lifts_the_tool_over_an_obstacle_and_brings_it_back(combine):
    command = [sys.executable, "-m", "surffollow", "arbiter", "demo", "--seconds", "12", "--json"]
    done = run_command([*command, "--combine", combine])
    assert done.returncode == 0, done.stdout + done.stderr
    reported = json.loads(done.stdout)
    assert reported["failures"] == []
    assert reported["least_standoff_over_obstacle_m"] > reported["obstacle_m"]


class FakeService:
    """A service that notes what is set."""

    def __init__(self):
        self.epoch, self.runs = 1, []

    def set_params(self, *, timeout_s=5.0, wait=True, run):
        self.runs.append(run)
        return self

    def done(self):
        return True

    def result(self, timeout_s):
        return 0


def test_the_follower_learns_only_while_it_holds_the_tool_whatever_becomes_of_its_process(tmp_path):
    # GIVEN a tool that an arbiter shares
    server = ArbiterProcess(tmp_path, arbiter_text("priority")).start()
    service = FakeService()
    run = RunByHolder(service, server.name, "tool", "follow")

    def becomes(desired):
        def is_set():
            run.update(time.monotonic_ns())
            return service.runs and service.runs[-1] == desired

        until(is_set)

    try:
        # THEN the follower learns nothing while no client leads
        becomes("dryrun")  # no client leads yet
        # WHEN the follower leads, THEN it learns
        follow_client = attach(server.name, "follow")
        assert follow_client.resource("tool").request()
        becomes("normal")
        # WHEN another one leads, THEN it learns nothing, after its death and a restart too
        with attach(server.name, "avoid") as avoider:
            assert avoider.resource("tool").request()
            becomes("dryrun")
            follow_client.close()  # or killed: the robot looks, not the follower
            service.epoch += 1  # a restarted service has its configuration's mode
            count = len(service.runs)
            until(lambda: run.update(time.monotonic_ns()) or len(service.runs) > count)
            assert service.runs[-1] == "dryrun"
        # WHEN the tool is shared no more, THEN it learns
        run.close()
        assert service.runs[-1] == "normal"
    finally:
        server.purge()


@contextlib.contextmanager
def reporting(service, server):
    """A robot of the arbiter's resource "tool" that reports the same pose again and again."""
    over = threading.Event()
    robot = attach_arbitrated(service.name, server.name, "tool")

    def report():
        while not over.wait(0.002):
            robot.ee_pos(POSE)

    thread = threading.Thread(target=report)
    thread.start()
    try:
        yield robot
    finally:
        over.set()
        thread.join()
        robot.close()


@pytest.fixture
def shared(tmp_path):
    with ArbiterProcess(tmp_path, arbiter_text("sum")).running() as server:
        yield server


def test_a_command_is_as_old_as_the_demand_that_it_hands_on(service, shared):
    """It had the time of sending: a demand from before a pause of the process was handed on as a new one."""
    over = threading.Event()

    def lead():
        follow(service.name, shared.name, "follow", over.is_set)

    thread = threading.Thread(target=lead)
    with (
        reporting(service, shared),
        attach_service(service.name) as demands,
        command_reader(shared.name, "follow") as commands,
    ):
        thread.start()
        try:
            made = set()

            def is_of_a_demand():
                made.add(demands.dev_vector().t_ns)
                command = commands.latest()
                return not command.safe and command.t_ns in made

            until(is_of_a_demand)
        finally:
            over.set()
            thread.join()


@pytest.fixture
def by_priority(tmp_path):
    with ArbiterProcess(tmp_path, arbiter_text("priority")).running() as server:
        yield server


def test_a_latched_stop_holds_the_robot_under_every_client(service, by_priority):
    """It held the follower's demands alone: another client moved the robot of a service that was stopped."""
    # GIVEN a robot that reports its pose, and a client that leads it
    with (
        reporting(service, by_priority) as robot,
        attach(by_priority.name, "avoid") as avoider,
        attach_service(service.name) as operator,
    ):
        tool = avoider.resource("tool")
        assert tool.request()

        def demand():
            tool.command(0.0, 0.0, 0.02, 0.0, 0.0, 0.0, ref_t_ns=time.monotonic_ns(), ref_pose=POSE)
            return robot.dev_vector()

        until(lambda: demand().valid)
        # WHEN the operator stops the service
        operator.stop("test")
        until(lambda: "STOPPED" in operator.dev_vector().names)
        # THEN no command is a demand, however often it comes
        for _ in range(50):
            stopped = demand()
            assert not stopped.valid
            assert "STOPPED" in stopped.names
        # WHEN the pose's holder resets the stop, THEN the client leads again
        until(lambda: robot.reset_stop(wait=True) is not None)
        until(lambda: demand().valid)


def test_the_follower_waits_for_an_arbiter_that_pauses(service, by_priority, monkeypatch):
    """Half a second without an answer ended it with an error: nothing followed any more."""
    over, silences, counts = threading.Event(), [], {}
    monkeypatch.setattr(shared_tool, "WAIT_S", 0.02)
    request = Resource.request

    def noted(self, **options):
        try:
            return request(self, **options)
        except RequestTimeoutError:
            silences.append(1)
            raise

    monkeypatch.setattr(Resource, "request", noted)

    def lead():
        counts.update(follow(service.name, by_priority.name, "tool", over.is_set))

    with attach(by_priority.name, "avoid") as avoider:
        tool = avoider.resource("tool")
        assert tool.request(timeout_s=5.0)
        thread = threading.Thread(target=lead)
        thread.start()
        try:
            until(lambda: avoider.status()["resources"]["tool"]["queue"])
            by_priority.freeze()
            until(lambda: silences)
            by_priority.go_on()
            tool.relinquish()
            until(lambda: (holder := avoider.holder("tool")) and holder.name == "follow")
        finally:
            by_priority.go_on()
            over.set()
            thread.join()
    assert counts["gained"] >= 1


def test_the_follower_says_that_the_arbiter_ended(service, by_priority):
    """Where it held the tool, it ended as if it had been asked to."""
    looks = []

    def stopped():
        looks.append(1)
        if len(looks) == 5:
            by_priority.stop()
        return False

    with pytest.raises(NotRunningError, match="ended"):
        follow(service.name, by_priority.name, "tool", stopped)


def test_the_follower_asks_for_no_resource_that_cannot_take_its_demand(service, tmp_path):
    """It held a resource of two values, and ended at its first valid demand."""
    looks = iter([False] * 20)  # no longer, should it begin
    with ArbiterProcess(tmp_path).running() as server:
        with pytest.raises(UsageError, match="takes speed, turn_rate; the demand of a service has x, y, z"):
            follow(service.name, server.name, "robot", lambda: next(looks, True), "go")
        with attach(server.name, "go") as client:
            assert client.status()["resources"]["robot"]["grants"] == 0


def test_an_offset_from_another_pose_is_converted_to_the_followers(service, shared):
    """20 mm above 0.104 m are 24 mm above the pose that the follower's demand is relative to."""
    # GIVEN a tool that reports its pose, and a follower that leads it
    over, counts = threading.Event(), {}
    robot = attach_arbitrated(service.name, shared.name, "tool")

    def report():
        while not over.wait(0.002):
            robot.ee_pos(POSE)

    def lead():
        counts.update(follow(service.name, shared.name, "follow", over.is_set))

    threads = [threading.Thread(target=work) for work in (report, lead)]
    for thread in threads:
        thread.start()
    try:
        until(lambda: robot.dev_vector().valid)
        read = []

        def settled():
            read.append(robot.dev_vector()[2])
            return len(read) > 150 and max(read[-150:]) - min(read[-150:]) < 2e-4

        until(settled)
        alone = read[-1]
        # WHEN another client adds an offset that is relative to another pose
        with attach(shared.name, "avoid") as avoider:
            offset = avoider.resource("offset")
            assert offset.request()
            other = (*POSE[:2], 0.104, *POSE[3:])
            seen = []

            def lifted():
                offset.command(*(0.0, 0.0, 0.02, 0.0, 0.0, 0.0), ref_t_ns=time.monotonic_ns(), ref_pose=other)
                demand = robot.dev_vector()
                if demand.valid and abs(demand[2] - alone) > 0.005:
                    seen.append(demand[2])
                return len(seen) >= 20

            # THEN the sum is relative to the follower's
            until(lifted)
            assert seen == pytest.approx([alone + 0.024] * len(seen), abs=1e-3)
    finally:
        over.set()
        for thread in threads:
            thread.join()
        robot.close()
    assert counts["commands"] > 0
    assert counts["without_pose"] <= 0.2 * counts["commands"] + 3
