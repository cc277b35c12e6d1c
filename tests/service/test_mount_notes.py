"""Mounts that give no surface normal are named in the status where rotations are asked for."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from running_service import Service, until
from surffollow.hw.driver import IDENTITY, Mount
from surffollow.service.mount_notes import mount_note
from surffollow.sim.mounts import around_tool

LEVEL = (0.0, 0.0, 0.0, 1.0)


def row(*places: tuple[float, float]) -> list[Mount]:
    """Sensors that look along the tool's axis."""
    return [(x, y, 0.0, *LEVEL) for x, y in places]


def tilted(angle: float, azimuth: float) -> Mount:
    """A sensor at the tool's origin that looks outwards."""
    s, c = math.sin(0.5 * angle), math.cos(0.5 * angle)
    return (0.0, 0.0, 0.0, -s * math.sin(azimuth), s * math.cos(azimuth), 0.0, c)


@pytest.mark.parametrize(
    ("mounts", "says"),
    [
        ([IDENTITY] * 3, "no mounts are given"),
        (row(*[(0.02, 0.0)] * 4), "the beams end within 0 mm"),
        (row((0.0, 0.0), (0.03, 0.03), (-0.03, -0.03)), "nearly on one line"),
        (row((0.0, 0.0), (0.03, 0.001), (-0.03, 0.0)), "nearly on one line"),
        ([tilted(0.2, 0.0), tilted(0.2, math.pi), IDENTITY], "nearly on one line"),
    ],
)
def test_mounts_without_a_normal_are_named(mounts: list[Mount], says: str) -> None:
    note = mount_note(mounts, 0.1)
    assert note.startswith(f"{len(mounts)} channels and orient = on, but ")
    assert says in note
    assert "or set orient = off" in note


@pytest.mark.parametrize(
    "mounts",
    [
        [IDENTITY],
        [IDENTITY] * 2,
        *(list(around_tool(n)) for n in range(3, 9)),
        [tilted(0.2, k * math.pi / 1.5) for k in range(3)],
    ],
)
def test_mounts_with_a_normal_and_fewer_than_three_sensors_are_not(mounts: list[Mount]) -> None:
    assert mount_note(mounts, 0.1) == ""


def test_the_status_shows_the_note_while_rotations_are_asked_for(
    make_service: Callable[..., Service],
) -> None:
    window = "range_min_m = 0.05\nrange_max_m = 0.3\nchannels = 3"
    service = make_service(kind="external", driver=window).start()
    with service.attach() as client:
        until(lambda: "no mounts are given" in str(client.status()["main"]["text"]), "the note")
        assert "no mounts are given" in service.run("status").stdout
        client.set_params(orient=0)
        until(lambda: "no mounts are given" not in str(client.status()["main"]["text"]), "the note's end")
