"""Channels of several that give no reading are named by the reason, in process and in the status."""

import math

import numpy as np
import pytest

from forecast.driving import Kernel, default_params
from surffollow import Follower
from surffollow.cli.status import follower_lines
from surffollow.client.follower_report import follower_report
from surffollow.shm.conversion import FLAG_INVALID
from surffollow.shm.layout_adaptive import REASON_CHANNELS, REASON_NAMES, REASON_SILENT, reason_text
from surffollow.shm.layout_follow import MODE_ADAPTIVE, Output
from surffollow.units import length_unit

MS = 1_000_000
RING = [(0.0, 0.0), (0.03, 0.0), (-0.015, 0.026), (-0.015, -0.026)]
LEADING = [(0.0, 0.0), (0.05, 0.0)]
SILENT = REASON_NAMES[REASON_SILENT]
NO_READING = "no reading for several sample intervals"


def follow(
    places, dead=(), lost=math.nan, dead_from_s=0.0, seconds=1.5, intervals=None, stretch=1.0, alive_s=None
):
    """A follower over flat ground, and what it says per millisecond; `intervals` [ms] per channel.

    Dead channels are alive again in the span `alive_s`.
    """
    f = Follower(
        {
            "sensors": [{"position_m": [x, y, 0.0]} for x, y in places],
            "plant": {"tau_s": 0.04 * stretch},
        },
        offset_m=0.1,
    )
    rng, said = np.random.default_rng(1), []
    alive = range(*(round(1e3 * t) for t in alive_s)) if alive_s else ()
    for ms in range(round(1e3 * seconds)):
        t_ns = round(ms * MS * stretch)
        if ms % 10 == 0:
            f.pose(t_ns, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        if ms % 4 == 0:
            ranges = 0.1 + 2e-4 * rng.standard_normal(len(places))
            for c in range(len(places)):
                if intervals is not None and ms % intervals[c]:
                    ranges[c] = math.nan
                elif c in dead and ms >= 1e3 * dead_from_s and ms not in alive:
                    ranges[c] = lost
            f.step(t_ns, ranges)
        state = f.state()
        said.append((state["health"], state["reason"], "VALID" in state["status"]))
    return f, said


@pytest.mark.parametrize("lost", [math.nan, 1.0], ids=["nothing", "out of the window"])
@pytest.mark.parametrize("dead_from_s", [0.0, 1.0])
@pytest.mark.parametrize(
    ("places", "dead", "named"),
    [
        (RING, [0], "channel 0"),
        (RING, [2], "channel 2"),
        (RING, [1, 3], "channels 1, 3"),
        (RING, [0, 1, 2], "channels 0, 1, 2"),
        (LEADING, [1], "channel 1"),
    ],
)
def test_dead_sensors_among_good_ones_are_named(places, dead, named, lost, dead_from_s):
    _, said = follow(places, dead, lost, dead_from_s)
    assert said[-1] == ("SUSPECT", f"{SILENT} ({named})", True)
    before = said[400 : round(1e3 * dead_from_s)]
    assert all(s == ("OK", "", True) for s in before)
    if before:
        assert said[1100][1], "a tenth of a second later"


@pytest.mark.parametrize(
    ("places", "dead", "named"), [(LEADING, [0], "channel 0"), (RING, [0, 1, 2, 3], "channels 0, 1, 2, 3")]
)
def test_a_drop_out_of_the_sensors_that_count_names_them(places, dead, named):
    _, said = follow(places, dead, dead_from_s=1.0)
    assert said[-1][:2] == ("DROPOUT", f"{NO_READING} ({named})")


def test_a_single_sensor_is_not_named():
    _, said = follow([(0.0, 0.0)], [0], dead_from_s=1.0)
    assert said[-1][:2] == ("DROPOUT", NO_READING)


def test_a_sensor_that_comes_back_is_named_no_longer():
    f, said = follow(RING, [1])
    assert said[-1][0] == "SUSPECT"
    for ms in range(1500, 2000, 4):
        f.pose(ms * MS, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(ms * MS, np.full(4, 0.1) + 1e-5 * (ms % 5))
    assert (f.state()["health"], f.state()["reason"]) == ("OK", "")


def test_a_slow_sensor_beside_a_fast_one_is_not_named_until_it_is_dead():
    _, said = follow(LEADING, [1], dead_from_s=3.0, seconds=5.0, intervals=(4, 200))
    assert {s[:2] for s in said[1000:3000]} == {("OK", "")}
    assert said[-1][:2] == ("SUSPECT", f"{SILENT} (channel 1)")


def test_the_time_of_it_scales_with_all_times():
    usual = follow(RING, [1], dead_from_s=0.5)[1]
    assert follow(RING, [1], dead_from_s=0.5, stretch=8.0)[1] == usual
    assert follow(RING, [1], dead_from_s=0.5, stretch=0.125)[1] == usual


def test_the_status_command_names_them_too():
    f, _ = follow(RING, [1, 3])
    output = {name: f._output[name][0].tolist() for name in (field.name for field in Output.FIELDS)}
    report = follower_report(output, MODE_ADAPTIVE)
    assert report["reason"] == f"{SILENT} (channels 1, 3)"
    assert f"SUSPECT ({SILENT} (channels 1, 3))" in follower_lines(report, length_unit(0.1))[0]


def test_conversions_that_the_driver_calls_invalid_are_no_reading():
    """The service's cycle: conversions of both channels every 1 ms, channel 1 flagged from 0.5 s on."""
    kernel = Kernel(default_params(mode=MODE_ADAPTIVE, n_channels=2))
    rng, reasons = np.random.default_rng(2), []
    for ms in range(1000):
        t_ns = 10**10 + ms * MS
        words = []
        for j in range(4):
            flags = FLAG_INVALID if j % 2 == 1 and ms >= 500 else 0
            words.append(((j - 4) * MS // 4, j % 2, flags, 2000 + int(rng.integers(-8, 9))))
        poses = [(t_ns, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if ms % 8 == 0 else ()
        reasons.append(int(kernel.step(t_ns, poses, words)["reason"]))
    assert reasons[499] == 0
    assert reason_text(reasons[-1]) == f"{SILENT} (channel 1)"


def test_a_reason_of_another_version_is_a_question_mark():
    assert reason_text(len(REASON_NAMES)) == "?"
    assert reason_text(-1) == "?"
    assert reason_text(REASON_SILENT | 1 << REASON_CHANNELS + 7) == f"{SILENT} (channel 7)"


def test_a_slow_channel_that_was_silent_for_long_is_named_as_soon_the_second_time():
    """GIVEN a channel of 10 Hz that was dead for 2 s WHEN it dies again THEN it is named."""
    _, said = follow(
        RING, dead=[2], dead_from_s=0.5, seconds=3.5, intervals=[4, 4, 100, 4], alive_s=(2.5, 2.95)
    )
    assert said[2850][1] == ""
    assert said[3400][1] == f"{SILENT} (channel 2)"


def test_the_reason_does_not_say_which_channels_count():
    """GIVEN a frozen channel 0, orient off WHEN good ones leave the window THEN none is said to be right."""
    f = Follower({"sensors": [{"position_m": [0.0, 0.02 * k, 0.0]} for k in (0, 1, -1)], "orient": "off"})
    for k in range(500):
        f.pose(k * 4 * MS, (4e-4 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(k * 4 * MS, [0.1 + 1e-4 * math.sin(k * k), *([0.01] * 2 if k > 300 else [0.1 + 1e-5 * k] * 2)])
    assert f.state()["reason"] == "some sensors give no reading within the window (channels 1, 2)"
