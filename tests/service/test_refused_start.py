"""A start that is refused leaves no object behind; one over a kept map leaves that map."""

from __future__ import annotations

from pathlib import Path

import pytest

from running_service import Service, config_text, objects_of


@pytest.mark.parametrize("follow", ['offset = "0.5 m"', 'range_min = "0.2 m"'])
def test_a_refused_start_leaves_nothing(tmp_path: Path, follow: str) -> None:
    service = Service(tmp_path, config_text(kind="simulated", follow=follow))
    try:
        process = service.launch()
        process.communicate()
        assert process.returncode == 2
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
