"""The simulated converter and sensors as the service meets them: time stamps, latency, holds, channels."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from surffollow.errors import ConfigError
from surffollow.hw.driver import IDENTITY, ConversionQueue, mounts_of
from surffollow.hw.simulation import adc
from surffollow.hw.simulation.led_config import FAR_M, NEAR_M, LedConfig, physics
from surffollow.hw.simulation.pose_history import PoseHistory, add_pose, pose_at
from surffollow.hw.simulation.sensor_rig import SimulatedConfig, make_rig, produce
from surffollow.shm.conversion import FLAG_INVALID, conversion_channel, conversion_counts, conversion_flags
from surffollow.shm.dtypes import zeros
from surffollow.sim.surfaces import flat_field, ramp_field

MS = 1_000_000
START = 10**12
FLAT = flat_field((0.0, 0.0, 1.0, 1.0))
CLEAN = LedConfig(noise_m=0.0, nonlinearity_m=0.0)
SCALE_M, ZERO_M = adc.calibration(NEAR_M, FAR_M)


def moved(z_m, first_ms: int = -200, last_ms: int = 600, x_m=lambda ms: 0.5) -> np.ndarray:
    """History of a tool that is at height z_m(ms)."""
    history = zeros(PoseHistory)
    for ms in range(first_ms, last_ms):
        pose = np.array([x_m(ms), 0.5, z_m(ms), 0.0, 0.0, 0.0, 1.0])
        add_pose(history, START + ms * MS, pose, np.zeros(6))
    return history


def conversions(config: SimulatedConfig, history: np.ndarray, until_ms: list[float], field=FLAT) -> dict:
    """Conversions of the driver from START on, produced in pieces that end at `until_ms`."""
    queue = ConversionQueue(1 << 16)
    rig = make_rig(config, queue, START)
    frame = np.array([field.x0_m, field.y0_m, field.grid_m])
    for ms in until_ms:
        produce(rig, physics(config.led, config.seed), history, field.heights_m, frame, START + int(ms * MS))
    items = queue.drain()
    words = items[:, 1]
    return {
        "items": items,
        "t_ns": items[:, 0],
        "channel": np.array([conversion_channel(w) for w in words]),
        "range_m": np.array([ZERO_M + SCALE_M * conversion_counts(w) for w in words]),
        "valid": np.array([not conversion_flags(w) & FLAG_INVALID for w in words]),
    }


def test_time_in_one_piece_or_in_many_gives_the_same_conversions() -> None:
    config = SimulatedConfig(channels=3, led=LedConfig(glitch_rate=0.05), seed=4)
    history = moved(lambda ms: 0.1 + 1e-5 * ms)
    whole = conversions(config, history, [200])
    rng = np.random.default_rng(0)
    pieces = conversions(config, history, [*np.sort(rng.uniform(0, 200, 333)), 200])
    assert np.array_equal(whole["items"], pieces["items"])
    assert len(whole["items"]) == 5000
    other = conversions(SimulatedConfig(channels=3, seed=5), history, [200])
    assert not np.array_equal(whole["items"], other["items"])


@pytest.mark.parametrize("channels", [1, 3, 8])
def test_converter_runs_free_at_25_khz_round_robin_over_its_channels(channels: int) -> None:
    got = conversions(SimulatedConfig(channels=channels), moved(lambda ms: 0.1), [100])
    assert set(np.diff(got["t_ns"])) == {40_000}
    assert set(np.diff(got["channel"]) % channels) == {1 % channels}
    per_channel = np.bincount(got["channel"], minlength=channels)
    assert abs(per_channel - 2500 / channels).max() <= 1


def test_value_is_held_for_4_ms_and_was_true_30_to_34_ms_before() -> None:
    config = SimulatedConfig(led=CLEAN, adc_noise_counts=0.0)
    rate_mps = 0.05
    got = conversions(config, moved(lambda ms: 0.1 + rate_mps * 1e-3 * ms), [400])
    ms = (got["t_ns"] - START) / MS
    age_ms = ms - (got["range_m"] - 0.1) / (rate_mps * 1e-3)
    assert age_ms.min() > 29.0  # one quantum is half a millisecond here
    assert age_ms.max() < 35.0
    assert age_ms.mean() == pytest.approx(32.0, abs=0.3)
    steps = got["t_ns"][1:][np.diff(got["range_m"]) != 0]
    assert set(np.diff(steps)) <= {3_960_000, 4_000_000, 4_040_000}


def test_averaging_7_conversions_does_not_average_a_held_value_s_noise_away() -> None:
    got = conversions(SimulatedConfig(), moved(lambda ms: 0.1), [500])
    mean_of_7 = got["range_m"][: len(got["range_m"]) // 7 * 7].reshape(-1, 7).mean(axis=1)
    assert mean_of_7.std() > 0.2e-3


def test_out_of_view_is_flagged_and_the_last_step_of_the_window_too() -> None:
    config = SimulatedConfig(led=CLEAN, adc_noise_counts=0.0)
    for height_m, valid in ((0.1, True), (0.0509, True), (0.1523, True), (0.153, False), (-0.01, False)):
        got = conversions(config, moved(lambda ms, h=height_m: h), [20])
        assert got["valid"].all() == valid
        assert got["valid"].any() == valid


def test_a_robot_that_is_not_there_or_stopped_reporting_gives_no_measurement() -> None:
    config = SimulatedConfig(led=CLEAN)
    assert not conversions(config, zeros(PoseHistory), [20])["valid"].any()
    gone = conversions(config, moved(lambda ms: 0.1, last_ms=100), [500])
    lost = gone["t_ns"][~gone["valid"]].min()
    # the last pose is believed for 100 ms, and the sensor shows it 30 ms later
    assert 229 <= (lost - START) / MS <= 234
    assert not gone["valid"][gone["t_ns"] > lost].any()
    returned = moved(lambda ms: 0.1, last_ms=50)
    add_pose(returned, START + 300 * MS, np.array([0.5, 0.5, 0.1, 0, 0, 0, 1.0]), np.zeros(6))
    back = conversions(config, returned, [400])
    seen = (back["t_ns"][back["valid"]] - START) / MS
    assert not ((seen > 85) & (seen < 329)).any()  # a gap of 250 ms is not interpolated
    assert (seen > 335).any()


def test_channels_look_from_their_own_mounts() -> None:
    ramp = ramp_field((0.0, 0.0, 1.0, 1.0), slope_x=0.2)
    mounts = ((-0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.1, 0.0, 0.01, 0.0, 0.0, 0.0, 1.0))
    config = SimulatedConfig(channels=2, mounts=mounts, led=CLEAN, adc_noise_counts=0.0)
    got = conversions(config, moved(lambda ms: 0.2), [20], ramp)
    for channel, expected in ((0, 0.2 - 0.08), (1, 0.21 - 0.12)):
        ranges = got["range_m"][got["channel"] == channel]
        assert ranges == pytest.approx(expected, abs=SCALE_M)


def test_pose_between_two_reports_is_interpolated_and_beyond_the_last_extrapolated_for_20_ms() -> None:
    history = zeros(PoseHistory)
    half = np.sqrt(0.5)
    add_pose(history, 0, np.array([0.0, 0, 0, 0, 0, 0, 1]), np.zeros(6))
    add_pose(history, 10 * MS, np.array([1.0, 0, 0, 0, 0, half, half]), np.array([100.0, 0, 0, 0, 0, 10.0]))
    out = np.zeros(7)
    assert pose_at(history, 5 * MS, out) == 1
    assert out[0] == pytest.approx(0.5)
    assert 2 * np.arctan2(out[5], out[6]) == pytest.approx(np.pi / 4)
    for after_ms, x, turn in ((10, 2.0, 0.1), (20, 3.0, 0.2), (60, 3.0, 0.2)):
        assert pose_at(history, (10 + after_ms) * MS, out) == 1
        assert out[0] == pytest.approx(x)
        assert 2 * np.arctan2(out[5], out[6]) == pytest.approx(np.pi / 2 + turn, abs=1e-3)
    assert pose_at(history, 111 * MS, out) == 0
    assert pose_at(history, -1, out) == 0
    assert add_pose(history, 10 * MS, out, np.zeros(6)) == 0


def test_history_keeps_the_newest_poses_when_it_is_full() -> None:
    history = moved(lambda ms: 1e-3 * ms, first_ms=0, last_ms=5000)
    out = np.zeros(7)
    assert pose_at(history, START + 4500 * MS + MS // 2, out) == 1
    assert out[2] == pytest.approx(4.5005)
    assert pose_at(history, START + 3000 * MS, out) == 0


def test_full_queue_counts_what_it_loses_and_keeps_the_oldest() -> None:
    queue = ConversionQueue(8)
    for n in range(11):
        queue.push(n, n)
    assert queue.overflow == 3
    assert queue.drain(2)[:, 0].tolist() == [0, 1]
    assert queue.drain()[:, 0].tolist() == [2, 3, 4, 5, 6, 7]
    assert len(queue) == 0


def test_mounts_are_completed_normalised_and_checked() -> None:
    mounts = mounts_of([(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0005)], 1)
    assert mounts == (IDENTITY,) * 8
    with pytest.raises(ConfigError, match="unit quaternion"):
        mounts_of([(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0)], 1)
    with pytest.raises(ConfigError, match="2 mounts for 1"):
        mounts_of([IDENTITY, IDENTITY], 1)


def test_what_a_helper_compiles_is_what_a_driver_runs() -> None:
    program = """
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.simulation.simulated import SimulatedDriver, produce, run_rig, warm_up
warm_up()
driver = SimulatedDriver("warm")
driver.start(ConversionQueue(1 << 10))
driver.stop()
print(len(produce.signatures), len(run_rig.signatures))
"""
    out = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert out.split() == ["1", "1"]
