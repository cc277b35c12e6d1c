"""One contract for all drivers, faults over any of them, and the registry."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from running_service import until
from surffollow.errors import ConfigError, DriverError, RecordingError
from surffollow.hw.driver import ConversionQueue, Driver, DriverInfo
from surffollow.hw.fault_injection import FaultState, FaultyDriver, inject_faults
from surffollow.hw.fault_schedule import FaultConfig, fault_delay_ns, fault_table
from surffollow.hw.registry import make_driver
from surffollow.hw.replayed import ReplayedDriver, save_conversions
from surffollow.hw.silent import SilentDriver
from surffollow.hw.simulation.sensor_rig import SimulatedConfig
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.shm.conversion import (
    FLAG_INVALID,
    conversion_channel,
    conversion_counts,
    conversion_dt_ns,
    conversion_flags,
    pack_conversion,
)
from surffollow.shm.dtypes import zeros
from surffollow.sim.surfaces import flat_field
from surffollow.sim.world import WorldPose, WorldReader, WorldWriter

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MS = 1_000_000
FLAT = flat_field((0.0, 0.0, 0.1, 0.1))
NAME = f"test-drivers-{os.getpid()}"
INFO = SilentDriver().info
RECORDED_T = np.arange(10**15, 10**15 + 400 * MS, MS)
RECORDED_WORDS = np.array([pack_conversion(100 + k, 0, 0, 5) for k in range(len(RECORDED_T))])


def simulated() -> Driver:
    return SimulatedDriver(NAME, SimulatedConfig(channels=2), FLAT)


def replayed() -> Driver:
    return ReplayedDriver(RECORDED_T, RECORDED_WORDS, INFO)


def faulty() -> Driver:
    return FaultyDriver(replayed(), [FaultConfig("spike", probability=0.1)])


DRIVERS = {"simulated": simulated, "replayed": replayed, "silent": SilentDriver, "faulty": faulty}


@pytest.fixture(params=DRIVERS)
def driver(request: pytest.FixtureRequest) -> Iterator[Driver]:
    made = DRIVERS[request.param]()
    yield made
    made.stop()


@pytest.fixture
def robot() -> Iterator[WorldWriter]:
    writer = WorldWriter(NAME)
    yield writer
    writer.close()


def publish_true_height(writer: WorldWriter, height_m: float) -> None:
    record = zeros(WorldPose)
    record["t_ns"] = time.monotonic_ns()
    record["pose"] = [0.05, 0.05, height_m, 0, 0, 0, 1]
    writer.write(record)


def test_every_driver_has_a_usable_description(driver: Driver) -> None:
    assert isinstance(driver, Driver)
    info = driver.info
    assert isinstance(info, DriverInfo)
    assert info.range_min_m < info.range_max_m
    assert all(s != 0.0 for s in info.scale_m[: info.n_channels])
    assert len(info.mounts) == len(info.scale_m) == len(info.zero_m) == 8
    assert info.latency_ns >= 0


def test_every_driver_stamps_ascending_times_of_the_past_and_known_channels(driver: Driver) -> None:
    queue = ConversionQueue()
    before = time.monotonic_ns()
    driver.start(queue)
    if not isinstance(driver, SilentDriver):
        until(lambda: len(queue) >= 20)
    driver.stop()
    items = queue.drain()
    now = time.monotonic_ns()
    assert (np.diff(items[:, 0]) >= 0).all()
    for t_ns, word in items.tolist():
        assert before - 200 * MS <= t_ns <= now
        assert 0 <= conversion_channel(word) < driver.info.n_channels
        assert conversion_dt_ns(word) == 0
    assert queue.overflow == 0


def test_every_driver_pushes_nothing_after_stop_and_may_be_started_again(driver: Driver) -> None:
    driver.stop()
    for _ in range(2):
        queue = ConversionQueue()
        driver.start(queue)
        if not isinstance(driver, SilentDriver):
            until(lambda q=queue: len(q) >= 5)
        with pytest.raises(DriverError, match="started twice"):
            driver.start(queue)
        driver.stop()
        queue.drain()
        now = time.monotonic()
        until(lambda t=now: time.monotonic() > t + 0.005)
        assert len(queue) == 0
        assert isinstance(driver.faults(), list)


def test_every_driver_goes_on_and_counts_when_the_queue_is_not_drained(driver: Driver) -> None:
    queue = ConversionQueue(4)
    driver.start(queue)
    if not isinstance(driver, SilentDriver):
        until(lambda: queue.overflow > 0)
    driver.stop()
    assert len(queue) <= 4


def test_simulated_sensor_finds_the_robot_says_when_it_is_gone_and_finds_the_next(
    robot: WorldWriter,
) -> None:
    driver = SimulatedDriver(NAME, SimulatedConfig(channels=2, pose="world"), FLAT)
    queue = ConversionQueue()
    driver.start(queue)

    def reads(writer: WorldWriter, height_m: float) -> bool:
        publish_true_height(writer, height_m)
        words = queue.drain()[-20:, 1]
        requested = (height_m - driver.info.zero_m[0]) / driver.info.scale_m[0]
        return any(
            not conversion_flags(w) and abs(conversion_counts(w) - requested) < 60 for w in words.tolist()
        )

    try:
        until(lambda: reads(robot, 0.08) and driver.faults() == [])
        robot.close()
        until(lambda: driver.faults() != [])
        assert NAME in driver.faults()[0] or "has not moved" in driver.faults()[0]
        second = WorldWriter(NAME)
        until(lambda: reads(second, 0.12) and driver.faults() == [])
        assert WorldReader(NAME).is_current
        second.close()
    finally:
        driver.stop()


def test_simulated_sensor_never_touches_a_block_that_was_taken_away() -> None:
    driver = SimulatedDriver(NAME, SimulatedConfig(channels=2, pose="world"), FLAT)
    driver.start(ConversionQueue())
    for k in range(30):
        writer = WorldWriter(NAME)
        publish_true_height(writer, 0.1)
        if k % 3 == 0:
            until(lambda: not any("no block" in f for f in driver.faults()))
        writer.close()
    driver.stop()


def test_replay_keeps_the_recorded_pace_and_says_when_it_is_over() -> None:
    driver = ReplayedDriver(RECORDED_T[:50], RECORDED_WORDS[:50], INFO)
    queue = ConversionQueue()
    driver.start(queue)
    until(lambda: driver.finished)
    assert "over" in driver.faults()[0]
    driver.stop()
    items = queue.drain()
    assert set(np.diff(items[:, 0])) == {MS}
    assert [conversion_counts(w) for w in items[:, 1].tolist()] == list(range(100, 150))


def test_recorded_conversions_survive_their_file(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    save_conversions(path, RECORDED_T, RECORDED_WORDS, INFO)
    driver = ReplayedDriver.from_file(path)
    assert driver.info.scale_m == INFO.scale_m
    assert driver.info.mounts == INFO.mounts
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(RecordingError, match="no recording"):
        ReplayedDriver.from_file(path)


@pytest.mark.parametrize(
    ("t_ns", "words"), [([], []), ([1, 2], [0]), ([2, 1], [0, 0]), ([[1], [2]], [[0], [0]])]
)
def test_replay_of_nonsense_is_refused(t_ns: list, words: list) -> None:
    with pytest.raises(RecordingError):
        ReplayedDriver(np.array(t_ns, np.int64), np.array(words, np.int64), INFO)


def spoilt(faults: list[FaultConfig], n: int = 4000, seed: int = 0, channels: int = 1) -> list:
    """(time [ms], word or None) of every conversion of 4 s at 1 kHz that counts upwards."""
    table, state = fault_table(faults, INFO), zeros(FaultState)
    state["seed"] = seed
    out = []
    for k in range(n):
        arrives, word = inject_faults(table, state, k * MS, pack_conversion(k, k % channels, 0, 0))
        out.append((k, word if arrives else None))
    return out


def test_dropout_swallows_its_window_and_nothing_else() -> None:
    out = spoilt([FaultConfig("dropout", start_s=1.0, end_s=1.5)])
    assert [k for k, word in out if word is None] == list(range(1000, 1500))


def test_stuck_repeats_the_last_counts_before_it_on_its_channel_only() -> None:
    out = spoilt([FaultConfig("stuck", start_s=1.0, end_s=2.0, channel=1)], channels=2)
    for k, word in out:
        expected = 999 if 1000 <= k < 2000 and k % 2 == 1 else k
        assert conversion_counts(word) == expected
        assert conversion_channel(word) == k % 2


def test_invalid_flags_but_still_delivers() -> None:
    out = spoilt([FaultConfig("invalid", start_s=0.5, end_s=0.6)])
    flagged = [k for k, word in out if conversion_flags(word) & FLAG_INVALID]
    assert flagged == list(range(500, 600))


def test_spikes_hit_whole_refreshes_at_their_rate_and_size() -> None:
    out = spoilt([FaultConfig("spike", probability=0.1, every_s=0.004, size_m=0.03)], n=40_000)
    error_m = np.array([(conversion_counts(w) - k) * INFO.scale_m[0] for k, w in out]).reshape(-1, 4)
    assert (error_m == error_m[:, :1]).all()
    hit = error_m[:, 0] != 0
    assert hit.mean() == pytest.approx(0.1, rel=0.1)
    assert 0.028 < abs(error_m).max() <= 0.03 + INFO.scale_m[0]
    again = spoilt([FaultConfig("spike", probability=0.1, every_s=0.004, size_m=0.03)], n=40_000, seed=1)
    assert [w for _, w in again] != [w for _, w in out]


def test_late_delays_only_its_window_by_the_longest_order() -> None:
    faults = [FaultConfig("late", start_s=1.0, end_s=2.0), FaultConfig("late", start_s=1.5, delay_s=0.2)]
    table, state = fault_table(faults, INFO), zeros(FaultState)
    delays = [fault_delay_ns(table, state, ms * MS, 0) // MS for ms in (900, 1200, 1700, 2500)]
    assert delays == [0, 50, 200, 200]


def test_late_conversions_arrive_late_in_order_and_with_their_true_stamps() -> None:
    driver = FaultyDriver(replayed(), [FaultConfig("late", delay_s=0.1)])
    queue = ConversionQueue()
    driver.start(queue)
    until(lambda: len(queue) > 0)
    arrived = time.monotonic_ns()
    first = queue.drain()[0, 0]
    until(lambda: len(queue) >= 50)
    driver.stop()
    assert arrived - first >= 100 * MS
    assert set(np.diff(queue.drain()[:, 0])) == {MS}


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "stuck", "start_s": 2.0, "end_s": 1.0},
        {"kind": "spike", "probability": 1.5},
        {"kind": "late", "delay_s": 3.0},
        {"kind": "late", "channel": 8},
        {"kind": "gremlins"},
        {"kind": "stuck", "colour": 1},
    ],
)
def test_a_schedule_that_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError):
        make_driver({"kind": "none", "faults": [wrong]}, NAME)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"faults": [{"kind": "gremlins"}]}, ["'gremlins'", "dropout, stuck, spike, late, invalid"]),
        ({"channels": 2, "mounts": [[0, 0, 0, 0, 0, 0, 1]]}, ["1 mounts for 2 channels", "one mount per"]),
        ({"mounts": [[0, 0, float("nan"), 0, 0, 0, 1]]}, ["mount 0", "nan", "finite"]),
        ({"mounts": [[0, 0, 0, 0, 0, 0, 2]]}, ["mount 0", "norm is 2", "must be 1"]),
        ({"led": {"latency_s": 3}}, ["latency_s", "3", "0.0 to 0.4 s"]),
        ({"led": {"latency": "30 ms", "latency_s": 0.03}}, ["driver.led", "latency and latency_s"]),
    ],
)
def test_a_wrong_set_up_is_reported_with_what_would_be_right(wrong: dict, says: list) -> None:
    with pytest.raises(ConfigError) as error:
        make_driver(wrong, NAME)
    for part in says:
        assert part in str(error.value)


def test_a_file_that_is_no_recording_is_reported_without_the_text_of_numpy(tmp_path: Path) -> None:
    made = {"text.npz": b"hello", "empty.npz": b"", "zip.npz": b"PK\x03\x04" + bytes(40)}
    for name, content in made.items():
        (tmp_path / name).write_bytes(content)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in (*made, "other.npz"):
        with pytest.raises(RecordingError, match=r"no recording of conversions.*save_conversions") as error:
            make_driver({"kind": "replay", "file": str(tmp_path / name)}, NAME)
        assert "pickle" not in str(error.value)
    with pytest.raises(RecordingError, match=r"cannot read .*No such file"):
        make_driver({"kind": "replay", "file": str(tmp_path / "none.npz")}, NAME)
    with pytest.raises(RecordingError, match="Is a directory"):
        make_driver({"kind": "replay", "file": str(tmp_path)}, NAME)


def test_the_example_of_the_page_plays_a_log_of_distances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a log, and the program and the settings of docs/reference/drivers.md
    monkeypatch.chdir(tmp_path)
    Path("laser.csv").write_text("time_s,distance_mm\n5.000,100.5\n5.001,\n5.002,250\n5.003,400\n")
    page = (Path(__file__).parents[2] / "docs/reference/drivers.md").read_text().split("## Replay")[1]
    exec(re.findall(r"```python\n(.*?)```", page, re.S)[0], {})
    settings = tomllib.loads(re.findall(r"```toml\n(.*?)```", page, re.S)[0])["driver"]
    # WHEN the driver plays it
    driver, queue = make_driver(settings, NAME), ConversionQueue()
    driver.start(queue)
    until(lambda: len(queue) == 4, "four distances")
    driver.stop()
    # THEN the service gets the distances at their distance in time, with the window of the settings
    assert (driver.info.range_min_m, driver.info.range_max_m, driver.info.latency_ns) == (0.05, 0.3, 2 * MS)
    got = queue.drain()
    assert np.diff(got[:, 0]).tolist() == [MS, MS, MS]
    invalid = [bool(conversion_flags(w) & FLAG_INVALID) for w in got[:, 1].tolist()]
    assert invalid == [False, True, False, False]
    range_m = [
        driver.info.zero_m[0] + driver.info.scale_m[0] * conversion_counts(w) for w in got[:, 1].tolist()
    ]
    assert [round(range_m[k], 6) for k in (0, 2, 3)] == [0.1005, 0.25, 0.4]


@pytest.mark.parametrize(
    ("arrays", "more", "error", "says"),
    [
        (
            {"t_ns": [1], "range_m": [0.1]},
            {"range_min_m": None},
            ConfigError,
            "set range_min_m and range_max_m",
        ),
        ({"t_ns": [1], "range_m": [0.1]}, {"range_min_m": 0.5}, ConfigError, "0.5 to 0.3 m"),
        ({"range_m": [0.1]}, {}, RecordingError, r"expected t_ns, range_m \(n,\)"),
        ({"t_ns": [1, 2], "range_m": [0.1]}, {}, RecordingError, "shapes"),
        ({"t_ns": [1.0], "range_m": [0.1]}, {}, RecordingError, "t_ns as float64"),
        ({"t_ns": [1], "range_m": [0.1], "channel": [8]}, {}, RecordingError, "outside 0 to 7"),
        ({"t_ns": [2, 1], "range_m": [0.1, 0.1]}, {}, RecordingError, "times go back"),
        ({"t_ns": [1], "range_m": [0.1]}, {"latency_s": 2.0}, ConfigError, "latency_s = 2.0"),
    ],
)
def test_a_wrong_file_of_distances_is_refused(
    tmp_path: Path, arrays: dict, more: dict, error: type[Exception], says: str
) -> None:
    np.savez(tmp_path / "r.npz", **{n: np.array(a) for n, a in arrays.items()})
    settings = {
        "kind": "replay",
        "file": str(tmp_path / "r.npz"),
        "range_min_m": 0.05,
        "range_max_m": 0.3,
    } | more
    with pytest.raises(error, match=says):
        make_driver({k: v for k, v in settings.items() if v is not None}, NAME)


def test_settings_replace_those_of_a_file_of_conversions(tmp_path: Path) -> None:
    save_conversions(tmp_path / "c.npz", RECORDED_T, RECORDED_WORDS, INFO)
    driver = make_driver(
        {"kind": "replay", "file": str(tmp_path / "c.npz"), "range_min_m": "10 mm", "latency_s": "3 ms"}, NAME
    )
    expected = (0.01, INFO.range_max_m, 3 * MS, INFO.scale_m)
    i = driver.info
    assert (i.range_min_m, i.range_max_m, i.latency_ns, i.scale_m) == expected


def test_registry_makes_each_kind_and_wraps_it_when_faults_are_ordered(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    save_conversions(path, RECORDED_T, RECORDED_WORDS, INFO)
    world = {"surface": "flat", "region": [0, 0, 0.1, 0.1]}
    assert isinstance(make_driver({"kind": "none"}, NAME), SilentDriver)
    assert isinstance(make_driver({"kind": "replay", "file": str(path)}, NAME), ReplayedDriver)
    made = make_driver({"channels": 2, "led": {"noise_m": 1e-3}, "world": world}, NAME)
    assert isinstance(made, SimulatedDriver)
    assert made.info.n_channels == 2
    slow = make_driver({"led": {"latency_s": "50 ms", "hold_hz": "0.5 kHz"}, "world": world}, NAME)
    assert slow.info.latency_ns == 51 * MS
    wrapped = make_driver({"kind": "none", "faults": [{"kind": "stuck"}]}, NAME)
    assert isinstance(wrapped, FaultyDriver)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "telepathy"},
        {"kind": "none", "x": 1},
        {"channels": 9},
        {"led": {"noise": 1}},
        {"channels": "x"},
    ],
)
def test_registry_refuses_what_it_does_not_know(wrong: dict) -> None:
    with pytest.raises(ConfigError):
        make_driver(wrong, NAME)
