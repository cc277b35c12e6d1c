"""Source of the simulated sensor's poses: the world block while it is written, else the reported poses."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from running_service import Service, drive, unique_name, until
from surffollow.errors import BusyError, ConfigError, PoseError
from surffollow.hw.driver import ConversionQueue, PoseQueue, reports_of
from surffollow.hw.fault_injection import FaultyDriver
from surffollow.hw.fault_schedule import FaultConfig
from surffollow.hw.registry import make_driver
from surffollow.hw.simulation.ground_check import OTHER_GROUND, GroundCheck
from surffollow.hw.simulation.led_config import LedConfig
from surffollow.hw.simulation.pose_history import PoseHistory, add_report, pose_at
from surffollow.hw.simulation.sensor_rig import SimulatedConfig
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.shm.conversion import conversion_counts, conversion_flags
from surffollow.shm.dtypes import zeros
from surffollow.sim.surfaces import flat_field
from surffollow.sim.world import WorldPose, WorldReader, WorldWriter

MS = 1_000_000
FLAT = flat_field((0.0, 0.0, 0.1, 0.1))
CLEAN = LedConfig(noise_m=0.0, nonlinearity_m=0.0)


@pytest.fixture
def name() -> str:
    return unique_name("poses")


def pose(height_m: float) -> list[float]:
    return [0.05, 0.05, height_m, 0.0, 0.0, 0.0, 1.0]


def publish_true_height(writer: WorldWriter, height_m: float) -> None:
    record = zeros(WorldPose)
    record["t_ns"], record["pose"] = time.monotonic_ns(), pose(height_m)
    writer.write(record)


class RunningDriver:
    """A simulated driver whose queue is looked at."""

    def __init__(self, name: str, source: str) -> None:
        config = SimulatedConfig(pose=source, led=CLEAN, adc_noise_counts=0.0)
        self.driver, self.queue = SimulatedDriver(name, config, FLAT), ConversionQueue()
        self.driver.start(self.queue)

    def report(self, height_m: float) -> None:
        self.driver.reports.push(time.monotonic_ns(), pose(height_m))

    def reads(self, height_m: float) -> bool:
        info, words = self.driver.info, self.queue.drain()[-20:, 1].tolist()
        ranges = [
            info.zero_m[0] + info.scale_m[0] * conversion_counts(w) for w in words if not conversion_flags(w)
        ]
        return any(abs(r - height_m) < 1e-4 for r in ranges)


@pytest.fixture
def start_driver(name: str) -> Iterator[Callable[[str], RunningDriver]]:
    made: list[RunningDriver] = []

    def make(source: str) -> RunningDriver:
        made.append(RunningDriver(name, source))
        return made[-1]

    yield make
    for r in made:
        r.driver.stop()


def test_without_a_world_block_the_sensor_uses_reported_poses_and_notes_it(
    start_driver: Callable[[str], RunningDriver],
) -> None:
    r = start_driver("auto")
    # before the first pose that is no fault: a service starts before its robot
    until(lambda: any("no pose is reported" in n for n in r.driver.notes()), "the note")
    assert r.driver.faults() == []

    def seen() -> bool:
        r.report(0.08)
        return r.reads(0.08) and r.driver.faults() == []

    until(seen, "a range from reports, and no fault")
    assert "errors of the reports cancel" in r.driver.notes()[0]
    until(lambda: any("no pose was reported for" in f for f in r.driver.faults()), "silence told")


def test_a_world_block_comes_before_reports_and_reports_come_back_when_its_writer_ends(
    start_driver: Callable[[str], RunningDriver], name: str
) -> None:
    r = start_driver("auto")
    writer = WorldWriter(name)

    def both(desired_m: float) -> bool:
        r.report(0.12)
        publish_true_height(writer, 0.08)
        return r.reads(desired_m)

    until(lambda: both(0.08), "the world's range")
    for _ in range(50):
        assert not both(0.12)
        time.sleep(0.001)
    assert r.driver.notes() == []
    writer.close()

    def reported() -> bool:
        r.report(0.12)
        return r.reads(0.12)

    until(reported, "a range from reports")


def test_a_robot_over_another_ground_is_noted_until_another_robot_comes(
    start_driver: Callable[[str], RunningDriver], name: str
) -> None:
    r = start_driver("auto")
    writer, record = WorldWriter(name), zeros(WorldPose)

    def noted(ground_m: float) -> bool:
        # tilted by 0.2 rad about y: the ground is that under the tool's axis, to the left of the tool
        record["t_ns"], record["standoff_m"], record["ground_m"] = time.monotonic_ns(), 0.08, ground_m
        record["pose"] = [0.05, 0.05, 0.08, 0.0, math.sin(0.1), 0.0, math.cos(0.1)]
        writer.write(record)
        return any(OTHER_GROUND in n for n in r.driver.notes())

    until(lambda: noted(-0.0012), "the note")  # the window is 101.6 mm long
    note = r.driver.notes()[-1]
    x_m = 0.05 - 0.08 * math.sin(0.2)
    says = (
        f"another ground than the simulated sensor sees: 1.2 mm apart at x {x_m:.3f} m, y 0.050 m. Give both"
    )
    assert says in note
    writer.close()
    # WHEN another robot knows no ground, or the same one but for its grid THEN there is no note
    writer = WorldWriter(name)
    until(lambda: not noted(math.nan), "the end of the note")
    assert not noted(0.0009)
    writer.close()


def test_grounds_that_differ_by_less_than_their_grids_do_are_one() -> None:
    check, record = GroundCheck(FLAT, 0.1), zeros(WorldPose)
    record["pose"], record["standoff_m"], record["ground_m"] = pose(0.1), 0.1, 0.0009
    check.look(record, 1)
    assert check.note == ""
    record["ground_m"] = 0.0011
    check.look(record, 1)
    assert "1.1 mm apart at x 0.050 m, y 0.050 m" in check.note


def test_a_silent_writer_keeps_the_block_for_a_stopped_robot_is_no_reason_to_use_reports(
    start_driver: Callable[[str], RunningDriver], name: str
) -> None:
    r = start_driver("auto")
    writer = WorldWriter(name)
    until(lambda: publish_true_height(writer, 0.08) or r.reads(0.08), "the world's range")
    until(lambda: any("has not moved" in f for f in r.driver.faults()), "the fault")
    r.report(0.12)
    assert not r.reads(0.12)
    writer.close()


@pytest.mark.parametrize(("source", "seen_m"), [("reported", 0.12), ("world", 0.08)])
def test_the_setting_chooses_whatever_else_there_is(
    source: str, seen_m: float, start_driver: Callable[[str], RunningDriver], name: str
) -> None:
    r = start_driver(source)
    writer = WorldWriter(name)

    def both() -> bool:
        r.report(0.12)
        publish_true_height(writer, 0.08)
        return r.reads(seen_m)

    until(both, "its range")
    writer.close()


def test_reports_are_carried_on_by_their_velocity_for_one_and_a_half_gaps() -> None:
    history, scratch, out = zeros(PoseHistory), np.zeros(6), np.zeros(7)
    angle = 0.1
    for k in range(2):
        half = 0.5 * angle * k
        at = np.array([0.01 * k, 0.0, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)])
        assert add_report(history, 30 * MS * k, at, scratch) == 1
    assert add_report(history, 30 * MS, at, scratch) == 0
    for after_ms, gaps in ((15, 0.5), (45, 1.5), (80, 1.5)):
        assert pose_at(history, (30 + after_ms) * MS, out) == 1
        assert out[0] == pytest.approx(0.01 * (1.0 + gaps))
        assert 2.0 * math.atan2(out[5], out[6]) == pytest.approx(angle * (1.0 + gaps), abs=5e-3)
    assert pose_at(history, 131 * MS, out) == 0


def test_faults_over_a_simulated_sensor_leave_it_its_reports(name: str) -> None:
    inner = SimulatedDriver(name, SimulatedConfig(), FLAT)
    assert reports_of(FaultyDriver(inner, [FaultConfig("stuck")])) is inner.reports
    assert isinstance(inner.reports, PoseQueue)
    assert reports_of(make_driver({"kind": "none"}, name)) is None


def test_an_unknown_source_is_refused_with_those_there_are(name: str) -> None:
    with pytest.raises(ConfigError, match=r"'truth'.*auto, reported, world"):
        make_driver({"pose": "truth"}, name)


def test_a_client_publishes_the_true_pose_and_its_velocity(service: Service) -> None:
    assert service.world is not None
    with service.attach() as client, pytest.raises(BusyError, match="live writer"):
        client.sim_pose(time.monotonic_ns(), pose(0.1))
    other = unique_name("tool")
    client = service.attach()
    client.name = other  # a block of its own, for this service's has a writer
    t_ns = time.monotonic_ns()
    client.sim_pose(t_ns, pose(0.1))
    client.sim_pose(t_ns + 10 * MS, pose(0.102))
    reader = WorldReader(other)
    got = reader.latest()
    assert got is not None
    assert got["t_ns"][0] == t_ns + 10 * MS
    assert got["pose"][0].tolist() == pose(0.102)
    assert got["velocity"][0] == pytest.approx([0, 0, 0.2, 0, 0, 0])
    client.sim_pose(t_ns + 20 * MS, pose(0.1), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert reader.latest()["velocity"][0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    for wrong in ((1.0,) * 5, (math.nan,) * 6, "abc"):
        with pytest.raises(PoseError, match="six finite numbers"):
            client.sim_pose(t_ns + 30 * MS, pose(0.1), wrong)
    with pytest.raises(PoseError):
        client.sim_pose(0.5, pose(0.1))
    assert reader.has_writer
    client.close()
    assert not reader.is_current
    assert not reader.has_writer
    reader.close()


def test_a_service_sees_the_true_pose_of_its_client_and_not_the_report(
    make_service: Callable[..., Service],
) -> None:
    service = make_service(kind="simulated").start()
    with service.attach() as client:

        def reads(distance_m: float) -> bool:
            client.sim_pose(time.monotonic_ns(), pose(0.09))
            return abs(client.raw_distance() - distance_m) < 1e-3

        drive(client, lambda: reads(0.09), pose(0.1), "the distance from the true pose")
        drive(
            client,
            lambda: client.sim_pose(time.monotonic_ns(), pose(0.09)) or not client.status()["main"]["text"],
            pose(0.1),
            "no note",
        )
        tool, client._tool = client._tool, None
        tool.close()
        drive(client, lambda: abs(client.raw_distance() - 0.1) < 1e-3, pose(0.1), "the distance from reports")
