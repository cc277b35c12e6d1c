"""Examples in docstrings give what they say, and every public name is shown in one."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from arbiter.arbiter_process import ArbiterProcess
from public_names import PACKAGES, public_names
from running_service import Service, until
from surffollow.arbiter import command_reader, observe

SRC = Path(__file__).parents[2] / "src"
MODULES = sorted(
    ".".join(path.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__")
    for path in SRC.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
# examples use these names; the test has servers under names of its own
SERVICE, ARBITER = '"surf"', '"cell"'
# names without an example of their own → the name whose example shows them
SHOWN_BY = {
    "arbiter.Holder": "arbiter.ArbiterClient",  # a result
    "arbiter.HistoryEvent": "arbiter.History",  # a result
    "hw.Source": "hw.PolledDriver",  # an interface, for the argument of that class
}


@pytest.fixture(scope="module")
def arbiter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArbiterProcess]:
    with ArbiterProcess(tmp_path_factory.mktemp("arbiter")).running() as one:
        yield one


def await_free(arbiter: ArbiterProcess) -> None:
    """Wait until the server has let go of the clients of the example before."""
    with observe(arbiter.name) as seen, command_reader(arbiter.name, "robot") as robot:
        until(lambda: not seen.status()["clients"] and robot.latest().safe, "a free arbiter")


def put_name(test: doctest.DocTest, shown: str, name: str) -> None:
    for example in test.examples:
        example.source = example.source.replace(shown, f'"{name}"')
        example.want = example.want.replace(shown.replace('"', "'"), f"'{name}'")


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(name: str, request: pytest.FixtureRequest) -> None:
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        source = "".join(example.source for example in test.examples)
        if SERVICE in source:
            service: Service = request.getfixturevalue("service")
            put_name(test, SERVICE, service.name)
        if ARBITER in source:
            arbiter: ArbiterProcess = request.getfixturevalue("arbiter")
            await_free(arbiter)
            put_name(test, ARBITER, arbiter.name)
        with np.printoptions(legacy="1.25", precision=8, suppress=False):
            runner.run(test)
    result = runner.summarize(verbose=False)
    assert result.attempted > 0
    assert result.failed == 0


def has_example(thing: object) -> bool:
    return "Examples\n" in (thing.__doc__ or "") and ">>> " in (thing.__doc__ or "")


def test_every_public_name_is_shown_in_an_example() -> None:
    """GIVEN the names of the site THEN each has an example, or another's shows it.

    An error without one is caught as the example of their base class shows.
    """
    pairs = ((f"{package}.{name}", thing) for package in PACKAGES for name, thing in public_names(package))
    things = {name.removeprefix("surffollow."): thing for name, thing in pairs}
    shown = {name for name, thing in things.items() if has_example(thing)}
    errors = {name for name in things if name.startswith("errors.") and name.endswith("Error")}
    assert "errors.SurffollowError" in shown
    assert things.keys() - shown - errors == SHOWN_BY.keys()
    assert set(SHOWN_BY.values()) <= shown
