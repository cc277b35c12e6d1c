"""A real service over flat simulated ground, and compilers with every warning an error."""

from __future__ import annotations

import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from cabi.running import CPP, PATIENT_MS, ROOT, SANITIZED, C, Probe, flat_ground
from running_service import Service, over_ground
from surffollow.shm.cheader import header_text

LARGEST = (
    ("tests/cabi/probe.c", "gcc", "C"),
    ("tests/cabi/probe.c", "g++", "C++"),
    ("examples/cpp/controller.cpp", "g++", "C++"),
    ("examples/c/controller.c", "gcc", "C"),
)


@pytest.fixture(scope="package")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that lives as long as this folder's tests, with one sensor 0.1 m over the ground."""
    with over_ground(tmp_path_factory.mktemp("service"), flat_ground()) as s:
        yield s


@pytest.fixture(scope="module")
def module_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service of a module's own, not started, with something to see for its sensor."""
    with over_ground(tmp_path_factory.mktemp("killable"), flat_ground(), started=False) as s:
        yield s


@pytest.fixture
def killable(module_service: Service) -> Iterator[Service]:
    """A living service that a test may kill or stop; the next test starts it again."""
    if module_service.process is None:
        module_service.start()
    yield module_service
    if module_service.process is not None:
        module_service.send(signal.SIGCONT)


@pytest.fixture(scope="session")
def compile_program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Path]]:
    """Compile a file or a text as "C" or "C++"; the program's path."""
    folder = tmp_path_factory.mktemp("programs")
    # of the layout as it is; that the committed header is the same is for test_header to say
    (folder / "surffollow.h").write_text(header_text())
    made: dict[tuple[str, ...], Path] = {}
    under_way: dict[tuple[str, ...], tuple[Path, list[str], subprocess.Popen[str]]] = {}

    def begin(source: Path | str, *flags: str, language: str = "C") -> tuple[str, ...]:
        """Start the compiler and do not wait for it."""
        key = (str(source), language, *flags)
        if key in made or key in under_way:
            return key
        number = len(made) + len(under_way)
        program = folder / f"program{number}"
        path = source if isinstance(source, Path) else folder / f"source{number}.c"
        if isinstance(source, str):
            path.write_text(source)
        compiler, standard = ("gcc", C) if language == "C" else ("g++", CPP)
        if shutil.which(compiler) is None:
            pytest.skip(f"no {compiler} on this machine")
        # programs of ours in C, compiled as C++, cast as C does; the header is stricter
        style = ["-x", "c++", "-Wno-old-style-cast"] if path.suffix == ".c" and language != "C" else []
        include = f"-I{folder}"
        command = [compiler, *standard, *style, include, *flags, "-o", str(program), str(path), "-lm"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        under_way[key] = program, command, process
        return key

    def build(source: Path | str, *flags: str, language: str = "C") -> Path:
        key = begin(source, *flags, language=language)
        if key in under_way:
            program, command, process = under_way.pop(key)
            _, errors = process.communicate()
            assert process.returncode == 0, f"{' '.join(command)}\n{errors}"
            made[key] = program
        return made[key]

    # compiled for most tests, while the service starts
    for source, compiler, language in LARGEST:
        if shutil.which(compiler) is not None:
            begin(ROOT / source, *SANITIZED, language=language)
    yield build
    for _, _, process in under_way.values():
        process.kill()
        process.communicate()


@pytest.fixture(params=["C", "C++"])
def make_probe(
    request: pytest.FixtureRequest, compile_program: Callable[..., Path]
) -> Iterator[Callable[..., Probe]]:
    """Starts sanitised probes, written in C and compiled as C and as C++."""
    probes: list[Probe] = []
    source = ROOT / "tests/cabi/probe.c"
    program = compile_program(source, *SANITIZED, language=request.param)

    def make(stale_ms: int = PATIENT_MS, before: Sequence[str] = (), **options: object) -> Probe:
        probes.append(Probe(*before, program, **options))
        if stale_ms:
            probes[-1](f"stale_ms {stale_ms}")
        return probes[-1]

    yield make
    for probe in probes:
        probe.end()
