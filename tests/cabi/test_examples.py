"""The C and C++ example controllers, sanitised, against a real service."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cabi.running import ROOT, SANITIZED, numbers, run
from running_service import STANDOFF_M, Service, config_text
from surffollow.map import HeightMap


@pytest.fixture(scope="module")
def moved_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service over flat ground whose simulated sensor moves with the reported poses."""
    text = config_text(kind="simulated").replace("0.1, 0.1]", "2.0, 1.0]")
    service = Service(tmp_path_factory.mktemp("moved"), text)
    try:
        yield service.start()
    finally:
        service.purge()


def quiet_run(program: Path, *words: str) -> dict[str, float]:
    """Output of a controller in a run that a busy machine did not delay; else of the last of ten runs.

    A delayed tick has no fresh demand: the controller holds its height and brakes, so its way is shorter.
    """
    for _ in range(10):
        done = subprocess.run([str(program), *words], capture_output=True, text=True, timeout=120.0)
        found = numbers(done.stdout)
        undelayed = found.get("worst_age_us", 0.0) < 20_000 and found.get("stale", 0.0) < 50
        if done.returncode == 0 and undelayed and found["refused"] == 0 and found["readings"] > 40:
            break
    assert done.returncode == 0, done.stderr
    return found


def test_c_controller_follows_the_service(
    moved_service: Service, compile_program: Callable[..., Path]
) -> None:
    program = compile_program(ROOT / "examples/c/controller.c", *SANITIZED)
    found = quiet_run(program, moved_service.name, "1.2")
    assert found["valid"] > 70  # of 120 ticks
    assert found["refused"] == 0
    assert found["stale"] < 50
    assert found["worst_age_us"] < 20_000
    assert found["z_m"] == pytest.approx(STANDOFF_M, abs=1e-3)
    assert found["standoff_rms_mm"] < 1.0
    assert found["poses"] > 70


def test_cpp_controller_follows_and_brings_a_map_home(
    moved_service: Service, compile_program: Callable[..., Path], tmp_path: Path
) -> None:
    program = compile_program(ROOT / "examples/cpp/controller.cpp", *SANITIZED, language="C++")
    found = quiet_run(program, moved_service.name, "1.2", str(tmp_path / "map.txt"))
    assert found["valid"] > 70  # of 120 ticks
    assert found["refused"] == 0
    assert found["max_demand_m"] == 0.02
    assert abs(found["map_height_m"]) < 1e-3
    assert found["standoff_rms_mm"] < 1.0
    brought = HeightMap.load(tmp_path / "map.txt")
    assert brought.samples > 30
    assert (brought.counts > 0).sum() >= 3  # 40 ticks that begin at rest are a way of more than 10 mm


def test_examples_say_what_is_wrong_when_no_service_runs(compile_program: Callable[..., Path]) -> None:
    for path, language in (("c/controller.c", "C"), ("cpp/controller.cpp", "C++")):
        program = compile_program(ROOT / "examples" / path, *SANITIZED, language=language)
        run(program, "no-such-service", code=1)


@pytest.mark.parametrize("seconds", ["abc", "-5", "0", "1e9999", "nan", "5x", ""])
def test_examples_refuse_what_is_no_time(compile_program: Callable[..., Path], seconds: str) -> None:
    for path, language in (("c/controller.c", "C"), ("cpp/controller.cpp", "C++")):
        program = compile_program(ROOT / "examples" / path, *SANITIZED, language=language)
        run(program, "no-such-service", seconds, code=2)
