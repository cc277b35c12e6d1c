"""Fixtures that need a running service; the service itself is in `running_service`."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from forked_start import note_environment
from older_click import capture_as_later_versions
from running_service import Service, config_text, over_ground
from surffollow.shm.jit import YOUNG_OBJECTS
from two_workers import make_scheduler


def pytest_configure() -> None:
    """Collect garbage seldom: tests and kernels are millions of objects that stay.

    Tests send signals; under nohup or in the background children would inherit that they are ignored.
    """
    gc.set_threshold(YOUNG_OBJECTS)
    capture_as_later_versions()
    for number, handler in ((signal.SIGHUP, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)


def pytest_collection_finish() -> None:
    """Commands are forked from a process with the environment that the tests begin with."""
    note_environment()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """With `-n`: whole modules, the long ones first."""
    return make_scheduler(config, log)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One simulated sensor 0.1 m over flat ground, alive for the whole module; do not kill it."""
    # many clients of many tests share it: rights are for service/test_policy.py
    text = config_text(kind="simulated", access='parameters = "any"\nmap = "any"')
    with over_ground(tmp_path_factory.mktemp("service"), text) as s:
        yield s


@pytest.fixture
def make_service(tmp_path: Path) -> Iterator[Callable[..., Service]]:
    """Make services of a test's own, not started; arguments as `config_text`."""
    made: list[Service] = []

    def make(**options: str) -> Service:
        made.append(Service(tmp_path, config_text(**options)))
        return made[-1]

    yield make
    for s in made:
        s.purge()


@pytest.fixture
def own_service(make_service: Callable[..., Service]) -> Service:
    """A running service without sensors that belongs to one test alone: kill it at will."""
    return make_service().start()
