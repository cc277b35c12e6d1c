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
        Quantity(float(NOW), (1.5,), (0.01,)),
        3.0,
    ],
    ids=[
        *("nothing", "raises", "old", "future", "nan", "lengths", "empty"),
        *("negative", "text", "complex", "no values", "no time", "time of a float", "no quantity"),
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


def test_no_time_that_the_block_cannot_hold_leaves_the_last_value_valid():
    """GIVEN a source whose time is a float THEN it has failed: `publish` raised, and 1.5 stayed valid."""
    said = [GOOD, Quantity(float(NOW + 1), (1.6,), (0.01,))]
    sensor = LogicalSensor("front_clearance", [Source("sonar", lambda: said.pop(0), 1.0)])
    name = f"logical{os.getpid()}"
    try:
        assert sensor.publish(name, NOW).source == 0
        assert sensor.publish(name, NOW + 1).source == -1
        with mem_attach({"front_clearance": LogicalReading}, name) as memory:
            assert memory.front_clearance.latest()["valid"] == 0
    finally:
        sensor.close()


@pytest.mark.parametrize(
    ("name", "max_age_s", "says"),
    [
        ("s" * 32, 1.0, "up to 31 bytes"),
        ("µ" * 16, 1.0, "up to 31 bytes"),
        ("\udc80", 1.0, "up to 31 bytes"),
        ("a\0b", 1.0, "no control character"),
        (5, 1.0, "up to 31 bytes"),
        ("sonar", math.nan, "max_age_s"),
        ("sonar", -1.0, "max_age_s"),
        ("sonar", "1", "max_age_s"),
    ],
)
def test_a_source_that_could_not_be_published_is_refused_at_once(name, max_age_s, says):
    """A long name raised in `publish` when the source was needed first: the last value stayed valid."""
    with pytest.raises(UsageError, match=says):
        LogicalSensor("front_clearance", [source("sonar", GOOD), source(name, SPARE, max_age_s)])


def test_the_longest_name_of_a_source_is_published():
    name, longest = f"logical{os.getpid()}", "s" * 31
    sensor = LogicalSensor("front_clearance", [source("sonar", None), source(longest, SPARE)])
    try:
        sensor.publish(name, NOW)
        with mem_attach({"front_clearance": LogicalReading}, name) as memory:
            assert memory.front_clearance.latest()["source_name"] == longest
    finally:
        sensor.close()


def test_a_sensor_without_sources_is_refused():
    with pytest.raises(UsageError, match="sources"):
        LogicalSensor("nothing", [])
