"""`sf_sim_pose`: a world block of a C client, read by the simulated sensor's reader."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from cabi.running import Probe
from running_service import Service, until
from surffollow.errors import NotRunningError
from surffollow.sim.world import WorldReader, WorldWriter

HELD, OBSERVER, POSE = -37, -26, -3
TRUE = "0.1 0.2 0.3 0 0 0 1"


def test_c_client_publishes_the_true_pose_and_removes_the_block(
    make_probe: Callable[..., Probe], own_service: Service
) -> None:
    probe = make_probe()
    assert probe(f"attach {own_service.name}").result == 0
    with pytest.raises(NotRunningError):
        WorldReader(own_service.name)
    assert probe(f"sim {TRUE}").result == 0
    reader = WorldReader(own_service.name)
    latest = reader.latest()
    assert latest is not None
    assert latest["pose"][0].tolist() == [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]
    assert latest["standoff_m"][0] != latest["standoff_m"][0]
    assert probe("sim 0 0 0 0 0 0 2").result == POSE
    assert reader.has_writer
    assert probe("detach").result == 0
    assert not reader.is_current
    reader.close()


def test_a_block_of_a_killed_c_client_is_taken_over_by_python_and_back(
    make_probe: Callable[..., Probe], own_service: Service
) -> None:
    probe = make_probe()
    probe(f"attach {own_service.name}")
    assert probe(f"sim {TRUE}").result == 0
    reader = WorldReader(own_service.name)
    epoch = reader.epoch
    probe.process.kill()
    probe.process.wait()
    until(lambda: not reader.has_writer, "the lock's end")
    writer = WorldWriter(own_service.name)
    assert reader.is_current
    assert reader.epoch > epoch
    second = make_probe()
    second(f"attach {own_service.name}")
    assert second(f"sim {TRUE}").result == HELD
    writer.close(unlink_it=False)
    assert second(f"sim {TRUE}").result == 0
    assert reader.is_current
    reader.close()


def test_beside_a_simulated_robot_and_as_an_observer_it_is_refused(
    make_probe: Callable[..., Probe], service: Service
) -> None:
    probe = make_probe()
    probe(f"attach {service.name}")
    assert probe(f"sim {TRUE}").result == HELD
    watcher = make_probe()
    watcher(f"observe {service.name}")
    assert watcher(f"sim {TRUE}").result == OBSERVER
