"""A start that is refused leaves no object behind; one over a kept map leaves that map."""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import WAIT_S, Service, config_text, objects_of

Make = Callable[..., Service]


@pytest.mark.parametrize("follow", ['offset = "0.5 m"', 'range_min = "0.2 m"'])
def test_a_refused_start_leaves_nothing(tmp_path: Path, follow: str) -> None:
    service = Service(tmp_path, config_text(kind="simulated", follow=follow))
    try:
        process = service.launch()
        process.communicate()
        assert process.returncode == 1
        assert objects_of(service.name) == set()
    finally:
        service.purge()


def test_a_refused_start_keeps_the_map_that_was_there(tmp_path: Path) -> None:
    service = Service(tmp_path)
    try:
        service.start().terminate()
        assert objects_of(service.name) == {f"{service.name}.map"}
        service.config.write_text(config_text(follow='offset = "-1 m"'))
        service.launch().communicate()
        assert objects_of(service.name) == {f"{service.name}.map"}
        service.process = None
    finally:
        service.purge()


@pytest.mark.parametrize("files", [24, 30, 36])
def test_a_start_with_too_few_descriptors_leaves_nothing(make_service: Make, files: int) -> None:
    """Wherever they run out, also while kernels are loaded."""
    s = make_service()
    limit = (files, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    process = s.launch(preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, limit))
    assert process.stdout is not None
    if process.stdout.readline().startswith("READY"):
        assert s.terminate() == 0  # they were enough on this machine
    else:
        process.communicate(timeout=WAIT_S)
        s.process = None
    assert objects_of(s.name) <= {f"{s.name}.map"}
