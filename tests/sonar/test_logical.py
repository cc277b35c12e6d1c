"""Logical sensors: the first source that works, its tolerance, its age."""

from __future__ import annotations

import math
import os
import time

import pytest

from surffollow.blocks import mem_attach
from surffollow.errors import UsageError
from surffollow.sonar.logical import LogicalReading, LogicalSensor, Quantity, Source

NOW = 10_000_000_000


def source(name, got, max_age_s=1.0):
    def read():
        if isinstance(got, Exception):
            raise got
        return got

    return Source(name, read, max_age_s)


GOOD = Quantity(NOW, (1.5,), (0.01,))
SPARE = Quantity(NOW, (1.4,), (0.2,))


@pytest.mark.parametrize(
    "failure",
    [
        None,
        RuntimeError("no reading"),
        Quantity(NOW - 2_000_000_000, (1.5,), (0.01,)),
        Quantity(NOW + 5, (1.5,), (0.01,)),
        Quantity(NOW, (math.nan,), (0.01,)),
        Quantity(NOW, (1.5, 2.0), (0.01,)),
        Quantity(NOW, (), ()),
        Quantity(NOW, (1.5,), (-0.01,)),
        Quantity(NOW, ("1.5",), (0.01,)),
        Quantity(NOW, (1.5 + 0j,), (0.01,)),
        Quantity(NOW, None, None),
        Quantity(None, (1.5,), (0.01,)),
        3.0,
    ],
    ids=[
        *("nothing", "raises", "old", "future", "nan", "lengths", "empty"),
        *("negative", "text", "complex", "no values", "no time", "no quantity"),
    ],
)
def test_the_alternative_takes_over_and_the_tolerance_says_so(failure):
    sensor = LogicalSensor("front_clearance", [source("sonar", failure), source("infrared", SPARE)])
    said = sensor.evaluate(NOW)
    assert said.quantity == SPARE
    assert (said.source, said.failed) == (1, 0b01)


def test_a_source_may_stamp_its_value_when_it_is_read():
    sensor = LogicalSensor(
        "front_clearance", [Source("sonar", lambda: Quantity(time.monotonic_ns(), (1.5,), (0.01,)), 1.0)]
    )
    name = f"logical{os.getpid()}"
    try:
        assert sensor.publish(name).source == 0
    finally:
        sensor.close()


def test_the_preferred_source_is_used_again_when_it_is_back():
    state = {"sonar": None}
    sensor = LogicalSensor(
        "front_clearance", [Source("sonar", lambda: state["sonar"], 1.0), source("infrared", SPARE)]
    )
    assert sensor.evaluate(NOW).source == 1
    state["sonar"] = GOOD
    assert sensor.evaluate(NOW).source == 0


def test_readers_see_value_tolerance_and_source():
    name = f"logical{os.getpid()}"
    sensor = LogicalSensor("front_clearance", [source("sonar", None), source("infrared", SPARE)])
    try:
        sensor.publish(name, NOW)
        with mem_attach({"front_clearance": LogicalReading}, name) as memory:
            now = memory.front_clearance.latest()
            assert (now["valid"], now["source"], now["source_name"]) == (1, 1, "infrared")
            assert (now["value"][0], now["tolerance"][0], now["t_ns"]) == (1.4, 0.2, NOW)
            sensor.publish(name, NOW + 5_000_000_000)
            assert memory.front_clearance.latest()["valid"] == 0
    finally:
        sensor.close()


def test_a_sensor_without_sources_is_refused():
    with pytest.raises(UsageError, match="sources"):
        LogicalSensor("nothing", [])
