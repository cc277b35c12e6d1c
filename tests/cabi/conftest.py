"""A real service over flat simulated ground, and compilers with every warning an error."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cabi.running import CPP, ROOT, SANITIZED, C, Probe, Service, StillWorld
from surffollow.shm.cheader import header_text


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that lives as long as this folder's tests, with one sensor 0.1 m over the ground."""
    s = Service(f"cabi-{os.getpid()}", tmp_path_factory.mktemp("service"))
    world = StillWorld(s.name)
    try:
        s.start()
        yield s
    finally:
        s.stop()
        world.close()


@pytest.fixture
def own_service(tmp_path: Path) -> Iterator[Service]:
    """A service of a test's own, not started, to be killed at will."""
    s = Service(f"cabi-own-{os.getpid()}", tmp_path)
    try:
        yield s
    finally:
        s.stop()


@pytest.fixture(scope="session")
def compile_program(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Compile a file or a text as "C" or "C++"; the program's path."""
    folder = tmp_path_factory.mktemp("programs")
    # of the layout as it is; that the committed header is the same is for test_header to say
    (folder / "surffollow.h").write_text(header_text())
    made: dict[tuple[str, ...], Path] = {}

    def build(source: Path | str, *flags: str, language: str = "C") -> Path:
        key = (str(source), language, *flags)
        if key in made:
            return made[key]
        program = folder / f"program{len(made)}"
        path = source if isinstance(source, Path) else folder / f"source{len(made)}.c"
        if isinstance(source, str):
            path.write_text(source)
        compiler, standard = ("gcc", C) if language == "C" else ("g++", CPP)
        if shutil.which(compiler) is None:
            pytest.skip(f"no {compiler} on this machine")
        # programs of ours in C, compiled as C++, cast as C does; what the header says is stricter
        style = ["-x", "c++", "-Wno-old-style-cast"] if path.suffix == ".c" and language != "C" else []
        include = f"-I{folder}"
        command = [compiler, *standard, *style, include, *flags, "-o", str(program), str(path)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr}"
        made[key] = program
        return program

    return build


@pytest.fixture(params=["C", "C++"])
def make_probe(
    request: pytest.FixtureRequest, compile_program: Callable[..., Path]
) -> Iterator[Callable[..., Probe]]:
    """Starts sanitised probes, written in C and compiled as C and as C++."""
    probes: list[Probe] = []
    source = ROOT / "tests/cabi/probe.c"
    program = compile_program(source, *SANITIZED, language=request.param)

    def make(**options: object) -> Probe:
        probes.append(Probe(program, **options))
        return probes[-1]

    yield make
    for probe in probes:
        probe.end()
