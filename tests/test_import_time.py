"""Imports of other programs stay light: no numba, no NumPy, a fraction of a second."""

from __future__ import annotations

import re
import subprocess
import sys
import time

import pytest

HEAVY = ("numba", "numpy", "llvmlite", "scipy", "mcap", "matplotlib", "asyncio")


def modules_after(code, *arguments):
    """Names of all modules loaded after running the code in a fresh process."""
    program = f"import sys\n{code}\nprint(' '.join(sys.modules), file=sys.stderr)"
    got = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True
    )
    return set(got.stderr.split())


def heavy(modules):
    return sorted({m.split(".")[0] for m in modules} & set(HEAVY))


def test_the_client_library_loads_neither_numba_nor_numpy():
    loaded = modules_after("import surffollow.client")
    assert "surffollow.client" in loaded
    assert heavy(loaded) == []


def test_the_package_itself_loads_nothing_heavy():
    assert heavy(modules_after("import surffollow")) == []


def test_declaring_a_schema_and_reading_configuration_need_no_numpy():
    loaded = modules_after(
        "import surffollow.shm.schema, surffollow.shm.layout_board, surffollow.shm.layout_slot\n"
        "import surffollow.shm.map_layout\n"
        "import surffollow.shm.objects, surffollow.config.service, surffollow.config.params"
    )
    assert heavy(loaded) == []


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["start", "--help"], ["stop", "--help"]])
def test_help_needs_nothing_heavy(arguments):
    code = (
        "from surffollow.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as e:\n    assert not e.code, e.code"
    )
    assert heavy(modules_after(code, *arguments)) == []


@pytest.mark.parametrize("more", [[], ["--json"], ["--purge"]])
def test_a_client_installation_stops_services(more):
    code = (
        "from surffollow.cli.main import main\n"
        "sys.modules.update(dict.fromkeys(('numpy', 'msgspec', 'numba')))  # an import of one fails\n"
        "try:\n    main(['stop', '--name', 'no-such-service', *sys.argv[1:]])\n"
        "except SystemExit as e:\n    assert e.code == 1, e.code\n"
        "assert 'surffollow.service.stale_objects' in sys.modules\n"
        "for name in ('numpy', 'msgspec', 'numba'):\n    del sys.modules[name]"
    )
    assert heavy(modules_after(code, *more)) == []


@pytest.mark.parametrize(
    ("command", "limit_s"),
    [(["-m", "surffollow", "--help"], 0.3), (["-c", "import surffollow.client"], 0.15)],
)
def test_a_user_does_not_wait_for_imports(command, limit_s):
    def processor_s():
        import resource

        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    processor_s()  # writes the byte code
    start = time.perf_counter()
    best = processor_s()
    for _ in range(20):
        best = min(best, processor_s())
        if best < limit_s:
            break
    # processor time, the best of a few: other work on the machine is not ours; tools/bench_start.py
    # takes wall time
    assert best < limit_s, f"{best:.3f} s of processor time (wall {time.perf_counter() - start:.2f} s)"


def test_dir_names_every_part_and_loads_none():
    code = "import surffollow\nprint(*dir(surffollow))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    parts = {"Follower", "arbiter", "blocks", "client", "errors", "hw", "map", "scan", "sonar", "units"}
    assert parts <= set(done.stdout.split())
    assert heavy(modules_after("import surffollow\ndir(surffollow)")) == []


@pytest.mark.parametrize("part", ["arbiter", "blocks", "client", "hw", "map", "scan", "sonar"])
def test_dir_and_help_of_a_part_show_its_names(part):
    code = f"import surffollow.{part} as part\nprint(*dir(part))\nprint(*part.__all__)\nhelp(part)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    shown, public, page = done.stdout.split("\n", 2)
    assert set(public.split()) <= set(shown.split())
    assert set(public.split()) <= set(re.findall(r"\w+", page))
    assert "class " in page
    if part in ("hw", "map", "scan", "sonar"):
        assert heavy(modules_after(f"import surffollow.{part}\ndir(surffollow.{part})")) == []


def test_a_part_is_there_without_an_import_of_its_own():
    assert "surffollow.client" in modules_after("import surffollow\nsurffollow.client.attach")


def test_help_of_the_package_names_its_parts():
    code = "import surffollow\nhelp(surffollow)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for part in ("surffollow.client", "surffollow.scan", "class Follower"):
        assert part in done.stdout, part
