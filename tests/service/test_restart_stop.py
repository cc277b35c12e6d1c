"""A stop is kept before it is answered; what ended comes back stopped where it would follow otherwise."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from running_service import STANDOFF_M, Service, World, drive, until
from surffollow.client import Client
from surffollow.service import memory as m
from surffollow.service.answers import params_hash
from surffollow.service.initialise import forget_parameters, stop_after_end
from surffollow.service.stop_latch import do_stop
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import STOP_REQUEST, STOP_RESTART, STOP_START

Make = Callable[..., Service]


def valid(client: Client) -> bool:
    return client.dev_vector().valid


def test_what_died_with_other_parameters_in_force_comes_back_stopped(killable: Service) -> None:
    """GIVEN another stand-off than configured WHEN the service is killed and starts THEN it is stopped."""
    with killable.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        for _ in range(2):  # a second death keeps it
            killable.kill()
            killable.start()
            drive(driver, lambda: driver.status()["stopped"] == ["restart"], what="the stop")
            assert not valid(driver)
        drive(driver, lambda: driver.slot >= 0, what="a slot of the new one")
        driver.sf_reset(0.09)
        assert not valid(driver)
        driver.reset_stop()
        drive(driver, lambda: valid(driver), what="a demand after the reset")
        assert driver.params()["offset_m"] == 0.09


def test_what_died_with_the_parameters_of_its_start_goes_on_by_itself(killable: Service) -> None:
    """GIVEN the parameters of the configuration WHEN the service is killed and starts THEN it follows by
    itself.
    """
    with killable.attach() as driver:
        driver.set_params(max_demand=0.01)
        driver.set_params(max_demand=0.05)
        driver.sf_reset(STANDOFF_M)
        drive(driver, lambda: valid(driver), what="a demand")
        killable.kill()
        killable.start()
        drive(driver, lambda: valid(driver), what="a demand of the new one")


def test_a_requested_end_under_a_robot_keeps_what_was_in_force_as_a_death_does(killable: Service) -> None:
    """GIVEN another stand-off and a pose holder WHEN the service is ended and starts THEN it is stopped."""
    with killable.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        for _ in range(2):  # a second end keeps it
            assert killable.terminate() == 0
            killable.start()
            drive(driver, lambda: driver.status()["stopped"] == ["restart"], what="the stop")
            assert not valid(driver)
        drive(driver, lambda: driver.slot >= 0, what="a slot of the new one")
        driver.sf_reset(0.09)
        driver.reset_stop()
        drive(driver, lambda: valid(driver), what="a demand after the reset")
        assert driver.params()["offset_m"] == 0.09


def test_a_requested_end_under_a_robot_with_the_configured_parameters_stops_nothing(
    killable: Service,
) -> None:
    """GIVEN the configured parameters WHEN the service is ended and starts THEN it follows."""
    with killable.attach() as driver:
        drive(driver, lambda: valid(driver), what="a demand")
        assert killable.terminate() == 0
        killable.start()
        drive(driver, lambda: valid(driver), what="a demand of the new one")


@pytest.mark.parametrize("leaves", ["releases the pose", "closes"])
def test_after_a_requested_end_without_a_robot_the_configuration_holds_and_nothing_stops(
    killable: Service, leaves: str
) -> None:
    """GIVEN another stand-off and no pose holder WHEN the service is ended THEN the next one follows."""
    with killable.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        if leaves == "closes":
            driver.close()
        else:
            driver.release_pose()
        assert killable.terminate() == 0
    killable.start()
    with killable.attach() as driver:
        drive(driver, lambda: valid(driver), what="a demand of the new one")
        assert driver.params()["offset_m"] == STANDOFF_M


class StopMemory:
    """The cycle's memory and the map's header without a service; slot 0 sends the pose."""

    def __init__(self) -> None:
        self._header, self._log = zeros(ml.MapHeader), np.zeros(lb.LogHead.SIZE // 8 + 4096, np.int64)
        self._log[lb.LogHead.offset("capacity") // 8] = 4096
        self._objects: Any = SimpleNamespace(map_header=self._header)
        self._memory = mem = m.make_cycle_memory(self._header, zeros(ml.GridPair, 1), None)
        mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY] = self._log.ctypes.data, 4096
        mem.ctx[m.POSE_SLOT], mem.ctx[m.POSE_CLAIM], mem.ctx[m.CLAIM] = 0, 7, 7

    @property
    def kept(self) -> int:
        """Causes that outlive the service."""
        return int(self._header[0]["stop"])

    @property
    def in_force(self) -> int:
        """Causes for which the follower is stopped."""
        return int(self._memory.state[0]["stop"])

    def ask(self, slot: int, request: int, counter: int) -> tuple[int, int]:
        """Result and detail of a request."""
        result, detail = do_stop(self._memory, slot, request, counter)
        return int(result), int(detail)

    def publish(self) -> None:
        """A cycle shows its demand, and with it the stop."""
        self._memory.output[0]["stop"] = self._memory.state[0]["stop"]

    def set_offset(self, offset_m: float) -> None:
        """The stand-off that the next start is configured for."""
        self._memory.params[0]["offset_m"] = offset_m

    def note_parameters(self) -> None:
        """The map keeps which parameters were in force."""
        self._header[0]["params_hash"] = params_hash(self._memory)

    def start_stops(self) -> bool:
        """Whether a start is stopped."""
        return bool(stop_after_end(self._memory, self._objects))

    def end_as_asked(self, claim_in_slot: int) -> bool:
        """End while the slot of the pose's holder has that claim; whether the parameters are forgotten."""
        self._memory.ctx[m.CLAIM] = claim_in_slot
        return forget_parameters(self._memory, self._objects)


def test_a_stop_is_kept_before_it_is_answered_and_no_reset_undoes_what_was_not_seen() -> None:
    memory = StopMemory()
    # WHEN a stop is asked for, THEN it is kept when it is answered
    assert memory.ask(3, lb.RQ_STOP, 1)[0] == lb.OK
    assert memory.kept == STOP_REQUEST
    # WHEN it is reset before a cycle has published it, THEN it remains
    assert memory.ask(0, lb.RQ_STOP_RESET, 1) == (lb.ERR_STOP_REMAINS, STOP_REQUEST)
    # WHEN it is reset afterwards, THEN it is over
    memory.publish()
    assert memory.ask(0, lb.RQ_STOP_RESET, 2) == (lb.OK, 0)
    assert memory.in_force == 0


def test_only_parameters_that_differ_stop_a_start() -> None:
    memory = StopMemory()
    memory.set_offset(0.1)
    assert not memory.start_stops(), "nothing is known of one before"
    # GIVEN parameters that were in force at a death
    memory.note_parameters()
    # WHEN the next start has the same ones, THEN it is not stopped
    assert not memory.start_stops()
    # WHEN one differs, THEN it is
    memory.set_offset(np.nextafter(0.1, 1.0))
    assert memory.start_stops()
    assert memory.kept == STOP_RESTART


def test_a_holder_that_has_left_its_slot_is_no_robot() -> None:
    memory = StopMemory()
    memory.set_offset(0.1)
    memory.note_parameters()
    memory.set_offset(0.11)
    # WHEN the end is requested while the holder has its slot, THEN its parameters count
    assert not memory.end_as_asked(7)
    # WHEN the slot is free or has another holder, THEN they do not
    assert memory.end_as_asked(0)
    memory.note_parameters()
    memory.set_offset(0.1)
    assert memory.end_as_asked(9)
    assert not memory.start_stops()


def test_a_cause_that_this_release_does_not_know_stops_too(make_service: Make) -> None:
    s = make_service(kind="simulated")
    s.world = World(s.name)
    try:
        s.start()
        s.kill()
        with open(f"/dev/shm/{s.name}.map", "r+b") as kept:
            kept.seek(ml.MapHeader.offset("stop"))
            kept.write((1 << 40).to_bytes(8, "little"))
        with s.start().observe() as watcher:
            until(lambda: watcher.status()["stopped"] == ["start"], f"the stop {STOP_START}")
    finally:
        s.world.close()
