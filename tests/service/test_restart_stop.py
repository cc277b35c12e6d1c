"""A stop is kept before it is answered; what died comes back stopped where it would follow otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from running_service import STANDOFF_M, Service, World, drive, until
from surffollow.client import Client
from surffollow.service import memory as m
from surffollow.service.initialise import stop_after_death
from surffollow.service.stop_latch import do_stop
from surffollow.shm import layout_board as lb
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import STOP_REQUEST, STOP_RESTART, STOP_START

Make = Callable[..., Service]


@pytest.fixture
def mortal(make_service: Make) -> Iterator[Service]:
    """A service with a simulated sensor over flat ground."""
    s = make_service(kind="simulated", access='parameters = "any"')
    s.world = World(s.name)
    yield s.start()
    s.world.close()


def valid(client: Client) -> bool:
    return client.dev_vector().valid


def test_what_died_with_other_parameters_in_force_comes_back_stopped(mortal: Service) -> None:
    """GIVEN another stand-off than configured WHEN the service is killed and starts THEN it is stopped."""
    with mortal.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        for _ in range(2):  # a second death keeps it
            mortal.kill()
            mortal.start()
            drive(driver, lambda: driver.status()["stopped"] == ["restart"], what="the stop")
            assert not valid(driver)
        drive(driver, lambda: driver.slot >= 0, what="a slot of the new one")
        driver.sf_reset(0.09)
        assert not valid(driver)
        driver.reset_stop()
        drive(driver, lambda: valid(driver), what="a demand after the reset")
        assert driver.params()["offset_m"] == 0.09


def test_what_died_with_the_parameters_of_its_start_goes_on_by_itself(mortal: Service) -> None:
    """GIVEN the parameters of the configuration WHEN the service is killed and starts THEN it follows by
    itself.
    """
    with mortal.attach() as driver:
        driver.set_params(max_demand=0.01)
        driver.set_params(max_demand=0.05)
        driver.sf_reset(STANDOFF_M)
        drive(driver, lambda: valid(driver), what="a demand")
        mortal.kill()
        mortal.start()
        drive(driver, lambda: valid(driver), what="a demand of the new one")


def test_after_an_end_in_good_order_the_configuration_holds_and_nothing_stops(mortal: Service) -> None:
    """GIVEN another stand-off WHEN the service is terminated and starts THEN the configuration holds and it
    follows.
    """
    with mortal.attach() as driver:
        driver.sf_reset(0.09)
        drive(driver, lambda: valid(driver), what="a demand")
        assert mortal.terminate() == 0
        mortal.start()
        drive(driver, lambda: valid(driver), what="a demand of the new one")
        assert driver.params()["offset_m"] == STANDOFF_M


@pytest.fixture
def memory() -> Iterator[m.CycleMemory]:
    """The cycle's memory without a service; slot 0 sends the pose."""
    header, log = zeros(ml.MapHeader), np.zeros(lb.LogHead.SIZE // 8 + 4096, np.int64)
    log[lb.LogHead.offset("capacity") // 8] = 4096
    mem = m.make_cycle_memory(header, zeros(ml.GridPair, 1), None)
    mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY] = log.ctypes.data, 4096
    mem.ctx[m.POSE_SLOT], mem.ctx[m.POSE_CLAIM], mem.ctx[m.CLAIM] = 0, 7, 7
    yield mem
    del log  # the memory has its address only


def test_a_stop_is_kept_before_it_is_answered_and_no_reset_undoes_what_was_not_seen(memory: Any) -> None:
    header = memory.header[0]
    assert do_stop(memory, 3, lb.RQ_STOP, 1)[0] == lb.OK
    assert header["stop"] == STOP_REQUEST
    assert do_stop(memory, 0, lb.RQ_STOP_RESET, 1) == (lb.ERR_STOP_REMAINS, STOP_REQUEST)
    memory.output[0]["stop"] = memory.state[0]["stop"]  # a cycle has published it
    assert do_stop(memory, 0, lb.RQ_STOP_RESET, 2) == (lb.OK, 0)
    assert memory.state[0]["stop"] == 0


def test_only_parameters_that_differ_stop_a_start(memory: Any) -> None:
    from surffollow.service.answers import params_hash

    memory.params[0]["offset_m"] = 0.1
    objects: Any = SimpleNamespace(map_header=memory.header)
    assert not stop_after_death(memory, objects), "nothing is known of one before"
    memory.header[0]["params_hash"] = params_hash(memory)
    assert not stop_after_death(memory, objects)
    memory.params[0]["offset_m"] = np.nextafter(0.1, 1.0)
    assert stop_after_death(memory, objects)
    assert memory.header[0]["stop"] == STOP_RESTART


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
