"""Ctrl-C while a command imports its modules is never lost: the import system may swallow an exception."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from running_service import Service, objects_of, unique_name
from surffollow.cli import main as main_module

SRC = Path(__file__).parents[2] / "src"
MORE = ("warnings", "signal", "_signal")
PLAIN = {**os.environ, "PYTHONPATH": str(SRC)}  # -S: no module of an environment comes before

# Ctrl-C arrives while a module is looked for, in code that lets no exception out
INTERRUPTING = """
import os, signal, sys

class Interrupting:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == os.environ["INTERRUPTED_MODULE"]:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                sum(range(100_000))
            except KeyboardInterrupt:
                pass

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupting)
"""


@pytest.mark.parametrize("module", ["click", "surffollow.cli.main", "msgspec", "surffollow.service.daemon"])
def test_an_interrupt_during_the_imports_of_start_ends_it(module: str, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING)
    config = tmp_path / "service.toml"
    config.write_text('[driver]\nkind = "none such"\n')  # what lost the interrupt ends there
    words = [sys.executable, "-m", "surffollow", "start", "--name", unique_name(), "--config", str(config)]
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    more = {"PYTHONPATH": os.pathsep.join(paths), "INTERRUPTED_MODULE": module}
    done = subprocess.run(words, env=os.environ | more, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (128 + signal.SIGINT, "", "")


def test_hardly_anything_is_imported_before_an_interrupt_ends_the_process_at_once() -> None:
    """The imports of typing and contextlib took longer than the start of Python itself."""
    looks = "there = set(sys.modules); import surffollow.cli.entry; print(*set(sys.modules) - there)"
    code = f"import os, re, sys; {looks}"  # an interpreter and the script of a command load these
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, env=PLAIN)
    ours = {n for n in done.stdout.split() if n.startswith("surffollow")}
    assert ours == {"surffollow", "surffollow.cli", "surffollow.cli.entry"}, done.stderr
    others = set(done.stdout.split()) - ours
    assert others <= {
        "__future__",
        "importlib",
        "importlib._bootstrap",
        "importlib._bootstrap_external",
        *MORE,
    }


def test_an_interrupt_while_the_options_are_read_ends_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(main_module.LazyGroup, "format_commands", interrupt)
    done = CliRunner().invoke(main_module.cli, ["--help"])
    assert (done.exit_code, done.output) == (128 + signal.SIGINT, "")


DRIVER = """
import os, signal
from surffollow.hw.silent import SilentDriver

def make(settings, name):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(100_000))
    except KeyboardInterrupt:
        if not settings["swallows"]:
            raise
    return SilentDriver()
"""


@pytest.mark.parametrize(("swallows", "code"), [("true", 0), ("false", 130)])
def test_an_interrupt_while_the_service_is_made_ends_it(
    swallows: str, code: int, tmp_path: Path, make_service: Callable[..., Service]
) -> None:
    (tmp_path / "interrupted.py").write_text(DRIVER)
    s = make_service(kind="interrupted:make", driver=f"swallows = {swallows}")
    process = s.launch(env=os.environ | {"PYTHONPATH": str(tmp_path)})
    assert process.stdout is not None
    assert process.stdout.readline() == "", "it is not ready"
    _, error = process.communicate()
    assert (process.returncode, error) == (code, "")
    assert objects_of(s.name) == set()
