"""The map that a service keeps: over a restart, a SIGKILL, and another configuration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, config_text, objects_of, unique_name
from surffollow.client import observe
from surffollow.errors import BlockError, ConfigError
from surffollow.map import HeightMap
from surffollow.service import shared_objects
from surffollow.service.name_owner import purge_map
from surffollow.shm import layout_board as lb

Make = Callable[..., Service]
REGION = (0.0, 0.0, 0.1, 0.1)


def map_bytes(name: str) -> bytes:
    return Path(f"/dev/shm/{name}.map").read_bytes()


def test_the_map_survives_a_restart_and_a_sigkill_byte_for_byte(make_service: Make) -> None:
    """GIVEN a map WHEN the service is terminated, started, killed and started THEN its bytes are the same."""
    s = make_service().start()
    with s.attach() as client:
        client.map_reset(REGION)
    s.terminate()
    kept = map_bytes(s.name)[4096:]
    s.start()
    with s.observe() as watcher:
        second = watcher.epoch
    s.kill()
    assert objects_of(s.name) == {s.name + part for part in ("", ".sock", ".lock", ".map")}
    s.start()
    assert map_bytes(s.name)[4096:] == kept
    with s.observe() as watcher:
        assert watcher.epoch > second
    assert s.run("stop", "--purge").returncode == 0
    assert objects_of(s.name) == set()


def test_the_configured_quantum_holds_from_every_map_reset_on(make_service: Make, tmp_path: Path) -> None:
    # GIVEN a map of the default quantum
    s = make_service().start()
    with s.attach() as client:
        client.map_reset((0.0, 0.0, 1.0, 1.0))
        of_old = client.map_window().quantum_m
    # WHEN the service is started with another quantum
    assert s.terminate() == 0
    s.config.write_text(config_text(map='quantum = "0.1 mm"'))
    s.start()
    with s.attach() as client:
        # THEN the kept map has its own, after a refocus too
        assert client.map_window().quantum_m == of_old
        assert of_old == pytest.approx(25.4e-6)
        client.map_refocus((0.2, 0.2, 0.8, 0.8))  # its heights are counts of the old quantum
        assert client.map_window().quantum_m == of_old
        # WHEN it is reset, THEN the new quantum holds
        client.map_reset((0.0, 0.0, 1.0, 1.0))
        assert client.map_window().quantum_m == 1e-4
        # WHEN a map with a third one is installed, THEN that holds until the next reset
        other = HeightMap.from_heights(np.zeros((4, 5)), origin_m=(0.0, 0.0), grid_m=0.1, quantum_m=5e-5)
        other.save(tmp_path / "other.txt")
        client.map_install(tmp_path / "other.txt")
        assert client.map_window().quantum_m == 5e-5
        client.map_reset((0.0, 0.0, 1.0, 1.0))
        assert client.map_window().quantum_m == 1e-4


def test_an_empty_map_is_named_with_a_remedy_that_works(make_service: Make) -> None:
    s = make_service(grids=1000)
    path = Path(f"/dev/shm/{s.name}.map")
    path.touch()
    with pytest.raises(BlockError, match=rf"is empty; remove it: surffollow stop --name {s.name} --purge"):
        shared_objects.open_shared_objects(s.settings())
    purge_map(s.name)
    shared_objects.open_shared_objects(s.settings()).leave()
    assert objects_of(s.name) == set()


def test_an_object_too_small_for_a_board_is_named_with_a_remedy() -> None:
    name = unique_name("small")
    path = Path(f"/dev/shm/{name}")
    for content, says in ((b"x", "remove it if no service made it"), (b"", "remove it if it stays so")):
        path.write_bytes(content)
        try:
            with pytest.raises(BlockError, match=says):
                observe(name)
        finally:
            path.unlink()


def test_a_kept_map_of_another_size_is_neither_used_nor_lost(make_service: Make) -> None:
    # GIVEN a kept map
    s = make_service(grids=1000)
    first = shared_objects.open_shared_objects(s.settings())
    first.set_state(lb.STATE_READY)
    first.leave()
    # WHEN the service is configured for another size
    s.config.write_text(config_text(grids=2000))
    before = map_bytes(s.name)
    # THEN its start is refused, and the map is as it was
    with pytest.raises(ConfigError, match=r"has room for 1000 grids.*asks for 2000.*--purge"):
        shared_objects.open_shared_objects(s.settings())
    assert map_bytes(s.name) == before
    assert objects_of(s.name) == {f"{s.name}.map"}
