"""The latched stop in real services: who enters it, who leaves it, what a kill and a replay make of it."""

from __future__ import annotations

import csv
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from running_service import (
    ATTACHED,
    POSE,
    READY_S,
    SENDING,
    STANDOFF_M,
    Service,
    World,
    config_text,
    drive,
    over_ground,
    program,
    said,
    until,
)
from second_user import AS_NOBODY, needs_root
from surffollow.client import Client
from surffollow.errors import RefusedError
from surffollow.record.convert import convert
from surffollow.record.replay import replay_file
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import STOPPED, VALID

Make = Callable[..., Service]
OPEN = 'board_mode = "0644"\nsocket_mode = "0666"\nmap_mode = "0644"'


@pytest.fixture(scope="module")
def following(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with a simulated sensor, whose objects every user may use."""
    with over_ground(tmp_path_factory.mktemp("stop"), config_text(kind="simulated", access=OPEN)) as s:
        yield s


def is_stopped(client: Client) -> bool:
    demand = client.dev_vector()
    if demand.status & STOPPED:
        assert not demand.status & VALID
        assert list(demand) == [0.0] * 6
        return True
    return False


def valid(client: Client) -> bool:
    return client.dev_vector().valid


def test_any_client_stops_and_only_the_poses_holder_resets(following: Service) -> None:
    with following.attach() as driver, following.attach(label="operator") as other:
        # GIVEN a robot that follows, and an operator
        driver.sf_reset(STANDOFF_M)
        drive(driver, lambda: valid(driver), what="a demand")
        # WHEN the operator stops it
        other.stop("smoke over cell 3")
        # THEN no demand is valid, and nothing but a reset by the pose's holder changes that
        drive(driver, lambda: is_stopped(driver), what="the stop")
        status = until(lambda: (s := driver.status())["stopped_by"] and s, "the trail")
        assert status["stopped"] == ["request"]
        (by,) = status["stopped_by"]
        assert (by["client"], by["reason"], by["causes"]) == ("operator", "smoke over cell 3", ["request"])
        shown = following.run("status").stdout
        assert "sf_stop_reset, surffollow simulate --reset-stop)\n         since 2" in shown
        assert f" request by operator, pid {os.getpid()}: smoke over cell 3\n" in shown
        with pytest.raises(RefusedError, match="sends the pose") as refused:
            other.reset_stop()
        assert refused.value.code == lb.ERR_NOT_POSE_HOLDER
        driver.sf_reset(STANDOFF_M)  # no way out
        driver.set_params(run="normal")
        seen = driver.status()["cycles"]
        drive(driver, lambda: driver.status()["cycles"] > seen + 200, what="200 cycles")
        assert is_stopped(driver)
        # WHEN the holder resets it
        driver.reset_stop()
        # THEN demands are valid again
        drive(driver, lambda: valid(driver), what="a demand after the reset")
        assert (driver.status()["stopped"], driver.status()["stopped_by"]) == ([], [])

        # THEN the audit trail tells of all three requests
        def requests() -> list[dict[str, object]]:
            return [e for e in driver.audit() if e["request"] in ("stop", "stop_reset")]

        until(lambda: requests()[-1:] and requests()[-1]["accepted"] and len(requests()) > 2, "the trail")
        stop, refused_reset, reset = requests()[-3:]
        assert (stop["client"], stop["reason"], stop["causes"]) == (
            "operator",
            "smoke over cell 3",
            ["request"],
        )
        assert (refused_reset["accepted"], reset["accepted"]) == (False, True)


@needs_root
def test_another_user_may_stop_but_not_start_again(following: Service) -> None:
    code = (
        "import sys; from surffollow.client import attach; from surffollow.errors import RefusedError\n"
        "c = attach(sys.argv[1], stale_min_s=1.0); c.stop('from nobody')\n"
        "try:\n    c.reset_stop(); print('reset')\nexcept RefusedError as e:\n    print(e.code, flush=True)\n"
        "sys.stdin.readline()"
    )
    # GIVEN a robot that follows
    with following.attach() as driver:
        drive(driver, lambda: valid(driver), what="a demand")
        # WHEN another user's client stops it and wants to reset it
        with program(code, following.name, before=AS_NOBODY) as other:
            # THEN it is stopped, and the reset is refused
            assert said(other) == str(lb.ERR_NOT_POSE_HOLDER)
            drive(driver, lambda: is_stopped(driver), what="the stop")
        # WHEN the pose's holder resets it, THEN demands are valid again
        driver.reset_stop()
        drive(driver, lambda: valid(driver), what="a demand after the reset")


def test_a_stop_outlives_the_kill_of_its_service(make_service: Make) -> None:
    s = make_service(kind="simulated")
    s.world = world = World(s.name)
    try:
        with s.start().attach() as driver:
            # GIVEN a stop that a client asked for
            driver.sf_reset(STANDOFF_M)
            drive(driver, lambda: valid(driver), what="a demand")
            driver.stop()
            drive(driver, lambda: is_stopped(driver), what="the stop")
            # WHEN the service is killed and started again
            s.kill()
            s.start()
            until(driver.reattach, "the new service")
            # THEN it is stopped for the same cause until the pose's holder resets it
            drive(driver, lambda: is_stopped(driver), what="the stop, still")
            assert driver.status()["stopped"] == ["request"]
            drive(driver, lambda: driver.slot >= 0, what="a slot of the new one")
            driver.reset_stop()
            drive(driver, lambda: valid(driver), what="a demand after the reset")
    finally:
        world.close()


def test_named_causes_stop_and_cannot_be_reset_while_they_last(make_service: Make) -> None:
    causes = ("pose_stale", "sensor_lost", "too_close", "pose_lost", "driver", "start", "descent")
    # a sensor that does not move with reported poses when no simulator publishes the true one
    # GIVEN a service that stops for every cause that it knows
    s = make_service(kind="simulated", follow='loss_timeout = "0.2 s"', driver='pose = "world"')
    s.config.write_text(s.config.read_text() + f"[stop]\non = {list(causes)}\n")
    s.world = world = World(s.name)
    try:
        s.start()
        with s.attach() as driver:
            # WHEN it starts, THEN it is stopped until a reset
            driver.ee_pos(POSE)
            assert driver.status()["stopped"][-1] == "start", "the first demand waits for a reset"
            # the sensor and the driver may have been late to begin
            drive(driver, lambda: _resets(driver) and valid(driver), what="a demand after a reset")
            # WHEN a cause begins, THEN it is stopped, and a reset is refused until the cause ends
            # the pose grows stale
            until(lambda: "pose_stale" in driver.status()["stopped"], "pose_stale")
            with pytest.raises(RefusedError, match="pose_stale") as refused:
                driver.reset_stop()
            assert refused.value.code == lb.ERR_STOP_REMAINS
            drive(
                driver,
                lambda: _resets(driver) and valid(driver),
                what="a demand after a reset with a fresh pose",
            )
            # the ground goes out of the sensor's sight
            world.pose = (*POSE[:2], 5.0, *POSE[3:])
            drive(driver, lambda: "sensor_lost" in driver.status()["stopped"], POSE, "sensor_lost")
            with pytest.raises(RefusedError, match="sensor_lost"):
                driver.reset_stop()
            world.pose = POSE
            drive(
                driver,
                lambda: _resets(driver) and valid(driver),
                what="a demand after a reset with the ground in sight",
            )
        # the holder dies
        with program(ATTACHED + SENDING, s.name) as holder, s.observe() as watcher:
            until(lambda: watcher.status()["main"]["pose_pid"] == holder.pid, "another holder")
            holder.kill()
            until(lambda: "pose_lost" in watcher.status()["stopped"], "pose_lost")
        # the driver has no news
        with s.attach() as driver:
            drive(driver, lambda: _resets(driver), what="a reset")
            world.close()
            drive(driver, lambda: "driver" in driver.status()["stopped"], what="driver")
            expected = {"pose_stale", "sensor_lost", "pose_lost", "driver"}
            until(lambda: expected <= causes_by_service(driver), "what the service stopped for by itself")
    finally:
        world.close()


def test_a_clean_end_of_the_poses_holder_is_no_loss_of_it(make_service: Make) -> None:
    # GIVEN a service that stops when the pose's holder is lost
    s = make_service(kind="simulated")
    s.config.write_text(s.config.read_text() + '[stop]\non = ["pose_lost"]\n')
    s.start()

    def causes_behind(end: str) -> list[str]:
        """Causes latched behind a holder that sends a pose and ends so."""
        with s.observe() as watcher, program(ATTACHED + end, s.name) as holder:
            holder.wait(READY_S)
            until(lambda: watcher.status()["main"]["clients"] == 0, "the slot is free")
            until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose is free")
            return list(watcher.status()["stopped"])

    # WHEN it closes, or comes to the end of its `with` block, THEN nothing is latched
    assert causes_behind("client.close()") == []
    assert causes_behind(f"with client:\n    client.ee_pos({POSE})") == []
    # WHEN an exception leaves the block, or the process ends without a close, THEN the stop is
    for end in ("with client:\n    1 / 0", "os._exit(0)"):
        assert causes_behind(end) == ["pose_lost"], end
        with s.attach() as driver:
            drive(driver, lambda: _resets(driver), what="a reset")


def test_a_service_waits_for_the_program_that_pushes_its_ranges_and_stops_when_it_ends(
    make_service: Make,
) -> None:
    s = make_service(kind="external", driver="range_min_m = 0.05\nrange_max_m = 0.3\nsilence_s = 0.1")
    s.config.write_text(s.config.read_text() + '[stop]\non = ["driver"]\n')
    s.start()
    with s.attach() as client:
        # GIVEN a service that stops for its driver, and no program that pushes yet, THEN it is not stopped
        until(lambda: "no client pushes its ranges" in client.status()["main"]["text"], "the note")
        s.cycles(300)
        assert client.status()["stopped"] == client.status()["faults"] == []
        # WHEN one has pushed and pushes no more, THEN it is stopped
        client.push_range(0, time.monotonic_ns(), 0.1)
        until(lambda: "driver" in client.status()["stopped"], "the stop")


def test_a_service_waits_for_its_simulated_robot_and_stops_when_that_ends(make_service: Make) -> None:
    # GIVEN a service that stops for faults of its simulated sensor
    s = make_service(kind="simulated")
    s.config.write_text(s.config.read_text() + '[stop]\non = ["driver"]\n')
    s.start()
    with s.attach() as driver:
        # WHEN there has been no pose yet, THEN it says so, and is not stopped
        until(lambda: "no pose is reported" in driver.status()["main"].get("text", ""), "the note")
        assert driver.status()["stopped"] == []
        # WHEN poses come, THEN its demands are valid; WHEN they end, THEN it is stopped
        drive(driver, lambda: valid(driver), what="a demand")
        until(lambda: "driver" in driver.status()["stopped"], "the stop")


def causes_by_service(client: Client) -> set[str]:
    return {c for e in client.audit() if e["client"] == "service" for c in e["causes"]}


def _resets(client: Client) -> bool:
    try:
        client.reset_stop()
    except RefusedError as e:
        if e.code == lb.ERR_STOP_REMAINS:
            return False
        raise
    return True


def test_a_recording_with_stops_replays_to_the_same_bits(following: Service, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"

    def size() -> int:
        return out.stat().st_size if out.exists() else 0

    # GIVEN a recording of stops and resets
    with following.attach() as driver, following.attach() as other:
        drive(driver, lambda: valid(driver), what="a demand")
        with following.recorder(out) as recorder:
            drive(driver, lambda: size() > 400_000, what="a recording of a second")
            for _ in range(2):
                drive(driver, lambda: valid(driver), what="a demand")
                other.stop()
                drive(driver, lambda: is_stopped(driver), what="the stop")
                driver.reset_stop()
            drive(driver, lambda: valid(driver), what="a demand")
            now = size()
            drive(driver, lambda: size() > now + 400_000, what="a recording of another second")
            recorder.send_signal(signal.SIGINT)
            recorder.communicate(timeout=READY_S)
    # WHEN it is replayed, THEN its bits are the same
    report = replay_file(out)
    assert report.identical, report
    assert report.events >= 4
    # WHEN it is converted, THEN every cycle has its row
    done = convert([out], "csv", rate_hz=0)
    assert (done.rows, done.differing, done.damage) == (report.cycles, 0, [])
    # THEN the channels went on while it was recorded: they end with the words, and tell of both stops
    with open(out, "rb") as file:
        found = list(make_reader(file).iter_messages(topics=["/state", "/log"]))
    times = [m.publish_time for _, c, m in found if c.topic == "/state"]
    lines = [m.data for _, c, m in found if c.topic == "/log"]
    with open(done.files[0]) as table:
        last_ns = int(list(csv.DictReader(table))[-1]["t_ns"])
    assert last_ns - times[-1] < 20_000_000
    for what in (b"stop latched: request", b"stop reset"):
        assert sum(what in line for line in lines) == 2, what
