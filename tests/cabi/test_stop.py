"""The latched stop and the refusals of the service's policy, as a C client sees them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from cabi.running import PATIENT_MS, ROOT, SANITIZED, Probe, numbers
from running_service import STANDOFF_M, Service, program, said, until
from surffollow.client import attach
from surffollow.client.demand import STALE
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import STOPPED, VALID

POSE = "ee 0.05 0.05 0.1 0 0 0 1"


def refused(error: int) -> int:
    return -100 - error


def demands(probe: Probe, expected: int) -> None:
    """Send poses until the demand has these status bits."""

    def step() -> bool:
        assert probe(POSE).result == 0
        answer = probe("dev")
        assert (answer.result == 0) == bool(int(answer.values[2]) & VALID)
        return bool(int(answer.values[2]) & expected)

    until(step, f"status {expected:#x}")


def test_a_c_client_stops_and_only_the_poses_holder_resets(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a robot that follows, and another client
    driver, other = make_probe(), make_probe()
    for p in (driver, other):
        assert p(f"attach {service.name}").result == 0
    assert driver(f"reset {STANDOFF_M}").result == 0
    demands(driver, VALID)
    # WHEN the other one stops it, THEN it may neither reset it nor change anything
    assert other("stop smoke").result == 0
    demands(driver, STOPPED)
    answer = other("stop_reset")
    assert (answer.result, answer.detail) == (refused(lb.ERR_NOT_POSE_HOLDER), driver.pid)
    assert other("set max_demand 0.01").result == refused(lb.ERR_NOT_POSE_HOLDER)
    assert other(f"reset {STANDOFF_M}").result == refused(lb.ERR_NOT_POSE_HOLDER)
    # WHEN the robot resets it, THEN demands are valid, and the audit trail has the stop
    assert driver("stop_reset").result == 0
    demands(driver, VALID)
    with attach(service.name, stale_min_s=PATIENT_MS / 1000) as watcher:
        # a cycle between the stop word and the request makes an entry of its own, without the reason
        stops = until(
            lambda: [e for e in watcher.audit() if e["pid"] == other.pid and e.get("reason")], "the reason"
        )
        found = [(e["request"], e["uid"], e["reason"]) for e in stops]
        assert found == [("stop", os.geteuid(), "smoke")]
    assert other("stop").result == 0, "a reason is not needed"
    demands(driver, STOPPED)
    assert driver("stop_reset").result == 0


def test_a_stop_waits_for_no_request_before_it_and_one_store_is_enough(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    # GIVEN a robot that follows
    driver = make_probe()
    assert driver("stop_now").result < 0, "there is no slot yet"
    assert driver(f"attach {service.name}").result == 0
    assert driver(f"reset {STANDOFF_M}").result == 0
    # WHEN it stops right behind a request, or by one store, THEN it is stopped
    for how in (f"send_and_stop {lb.RQ_SF_RESET} {STANDOFF_M}", "stop_now"):
        demands(driver, VALID)
        assert driver(how).result == 0
        demands(driver, STOPPED)
        assert driver.until("stop_reset", lambda a: a.result == 0).result == 0


def test_detaching_is_no_loss_of_the_pose_and_letting_go_is_one(
    make_probe: Callable[..., Probe], make_service: Callable[..., Service]
) -> None:
    # GIVEN a service that stops when the pose's holder is lost
    s = make_service()
    s.config.write_text(s.config.read_text() + '[stop]\non = ["pose_lost"]\n')
    s.start()
    driver = make_probe()
    with s.observe() as watcher:
        for how, causes in (("detach", []), ("forget", ["pose_lost"])):
            assert driver(f"attach {s.name}").result == 0
            assert driver(POSE).result == 0
            # WHEN the holder detaches, or lets go without a release
            assert driver(how).result == 0
            until(lambda: watcher.status()["main"]["clients"] == 0, "the slot is free")
            until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose is free")
            # THEN a stop is latched for the second alone
            if causes:
                until(lambda: watcher.status()["stopped"] != [], "the stop is latched")
            s.cycles(2)
            assert watcher.status()["stopped"] == causes, how


def test_a_demand_of_the_future_is_of_another_clock(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    """In a time namespace that is 1000 s behind, the age of a demand is unknown."""
    behind = ["unshare", "--time", "--monotonic", "-1000"]
    if subprocess.run([*behind, "true"], capture_output=True).returncode != 0:
        pytest.skip("no time namespace can be made here")
    driver = make_probe()
    assert driver(f"attach {service.name}").result == 0
    assert driver(f"reset {STANDOFF_M}").result == 0
    demands(driver, VALID)
    watcher = make_probe(before=behind)
    watcher(f"observe {service.name}")
    assert watcher("dev").result != 0
    assert int(watcher("dev").values[2]) & STALE
    code = (
        "import sys; from surffollow.client import observe; o = observe(sys.argv[1], stale_min_s=1.0); "
        "print(o.dev_vector().valid, o.dev_vector_into(bytearray(88)), o.alive())"
    )
    with program(code, service.name, before=[*behind, "--fork"]) as python:
        assert said(python) == "False False False"


# stops the service named by the first word as soon as a robot is driven
STOPPER = """
import sys, time
from surffollow.client import attach
c = attach(sys.argv[1], stale_min_s=1.0)
while not c.dev_vector().valid:
    time.sleep(0.002)
c.stop("test")
print("stopped", flush=True)
sys.stdin.readline()
"""


def test_the_example_controller_brakes_and_stays_when_the_service_is_stopped(
    service: Service, compile_program: Callable[..., Path]
) -> None:
    # GIVEN the controller of the examples
    controller = compile_program(ROOT / "examples/c/controller.c", *SANITIZED)
    # WHEN another client stops the service while it drives
    with program(STOPPER, service.name):
        done = subprocess.run(
            [str(controller), service.name, "3"], capture_output=True, text=True, timeout=120
        )
    try:
        # THEN it brakes and stays where it is
        assert done.returncode == 0, done.stderr
        found = numbers(done.stdout)
        assert found["stopped"] > 50
        assert found["speed_mps"] == 0.0
        assert found["path_m"] < 3 * 0.05 - 0.02, "it did not go on to the end of its way"
    finally:
        with attach(service.name, stale_min_s=PATIENT_MS / 1000) as driver:
            driver.claim_pose()
            driver.reset_stop()
