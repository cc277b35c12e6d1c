"""Heights of a service's map: their range follows from the stand-off, and none beyond it is stored."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, run_command, until
from surffollow.client import Client
from surffollow.map import HeightMap
from surffollow.record.map_rebuild import rebuild_map
from surffollow.shm.map_layout import DEFAULT_QUANTUM_M

Make = Callable[..., Service]
LONG_RANGE = {
    "kind": "external",
    "driver": "range_min_m = 0.5\nrange_max_m = 30.0",
    "follow": 'offset = "10 m"\ntoo_close = "0.6 m"\ntoo_close_exit = "0.8 m"\nmax_demand = "5 m"',
}
REGION = (0.0, 0.0, 60.0, 10.0)


def visit(client: Client, x_m: float, ground_m: float, met: Callable[[], bool]) -> None:
    """Stand at a place over the ground, the tool at height 0, until something holds."""

    def step() -> bool:
        t_ns = time.monotonic_ns()
        client.ee_pos((x_m, 5.0, 0.0, 0.0, 0.0, 0.0, 1.0), t_ns)
        client.push_range(0, t_ns, -ground_m)
        return met()

    until(step, f"the map at {x_m} m")


def test_a_relief_of_metres_below_a_stand_off_of_metres_is_in_the_map_and_in_the_replays(
    make_service: Make, tmp_path: Path
) -> None:
    # GIVEN a service without a quantum in its configuration, a stand-off of 10 m, and a recorder
    s, out = make_service(**LONG_RANGE, grids=1_000_000).start(), tmp_path / "run.mcap"
    with s.recorder(out) as recorder:
        until(out.exists, "the file")
        with s.attach() as client:
            client.map_reset(REGION)
            assert client.map_window().quantum_m == pytest.approx(100 * DEFAULT_QUANTUM_M)
            # WHEN the ground falls and rises by metres
            places = {5.0: -10.0, 10.0: -13.0, 15.0: -7.0}
            for x, ground in places.items():
                visit(client, x, ground, lambda x=x: math.isfinite(client.map_height(x, 5.0)))
            # THEN the live map has its heights, none lost
            live = [client.map_height(x, 5.0) for x in places]
            np.testing.assert_allclose(live, list(places.values()), atol=6e-3)
            assert client.map_facts()["clipped"] == 0
            known = client.map_window()
        recorder.send_signal(signal.SIGTERM)
        recorder.communicate(timeout=60)
    # AND the map of the recording has them, in the same counts from the same datum
    rebuilt = rebuild_map(out).map
    assert (rebuilt.quantum_m, rebuilt.datum_m) == (known.quantum_m, known.datum_m)
    again = [rebuilt.height_at(x, 5.0) for x in places]
    np.testing.assert_allclose(again, list(places.values()), atol=6e-3)


def test_the_quantum_of_a_map_reset_follows_from_the_stand_off_in_force(make_service: Make) -> None:
    s = make_service().start()
    with s.attach() as client:
        client.map_reset((0.0, 0.0, 0.1, 0.1))
        assert client.map_window().quantum_m == DEFAULT_QUANTUM_M
        client.sf_reset(0.12)
        assert client.map_window().quantum_m == DEFAULT_QUANTUM_M  # of this map it stays
        client.map_reset((0.0, 0.0, 0.1, 0.1))
        assert client.map_window().quantum_m == pytest.approx(1.2 * DEFAULT_QUANTUM_M)


def test_heights_beyond_the_range_are_unknown_and_named_with_the_setting(
    make_service: Make, tmp_path: Path
) -> None:
    # GIVEN a service whose configured quantum is too fine for the ground
    s = make_service(**LONG_RANGE, map='quantum = "25.4 um"').start()
    with s.attach() as client:
        client.map_reset(REGION)
        visit(client, 5.0, -10.0, lambda: math.isfinite(client.map_height(5.0, 5.0)))
        assert "beyond the map's heights" not in s.run("status").stdout
        # WHEN the ground leaves the range
        visit(client, 10.0, -13.0, lambda: client.map_facts()["clipped"] > 0)
        # THEN the map shows no height there
        assert math.isnan(client.map_height(10.0, 5.0))
        assert client.map_height(5.0, 5.0) == pytest.approx(-10.0, abs=1e-3)
    # AND the status names number, range and setting
    text = s.run("status").stdout
    assert "samples were beyond the map's heights, -10.8" in text
    assert "to -9.16" in text
    assert "A map.quantum above 25.4 µm" in text
    # AND so do the upload of the map, and the commands that read the file
    file = tmp_path / "ground.txt"
    surffollow = [s.python, "-m", "surffollow"]
    upload = [*surffollow, "map", "upload", str(file), "--name", s.name]
    # once more where a busy machine stands still
    until(lambda: "map.quantum" in run_command(upload).stderr, "the upload")
    shown = run_command([*surffollow, "map", "info", str(file), "--json"])
    assert json.loads(shown.stdout)["clipped"] == HeightMap.load(file).clipped > 0
    assert "samples were beyond the map's heights" in shown.stderr
    path = tmp_path / "path.csv"
    planned = run_command(
        [*surffollow, "scan", "plan", str(file), "--gap", "5m", "--speed", "1", "-o", str(path)]
    )
    assert "samples were beyond the map's heights" in planned.stderr
