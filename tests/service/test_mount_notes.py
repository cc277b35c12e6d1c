"""Mounts that give no surface normal, and beams that point upward, are named in the status."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import Service, drive, until
from surffollow.hw.driver import IDENTITY, Mount
from surffollow.service.mount_notes import beam_note, beam_tilt, mount_note
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


@pytest.mark.parametrize(
    ("pose", "mount", "degrees"),
    [
        (LEVEL, LEVEL, 0.0),
        ((1.0, 0.0, 0.0, 0.0), LEVEL, 180.0),
        (LEVEL, (1.0, 0.0, 0.0, 0.0), 180.0),
        ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), 0.0),
        ((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), LEVEL, 90.0),
        ((0.0, math.sin(0.9), 0.0, math.cos(0.9)), LEVEL, math.degrees(1.8)),
    ],
)
def test_the_tilt_of_a_beam_is_that_of_pose_and_mount(
    pose: tuple[float, ...], mount: tuple[float, float, float, float], degrees: float
) -> None:
    whole = (0.0, 0.0, 0.1, *pose)
    assert math.degrees(beam_tilt(whole, (0.0, 0.0, 0.0, *mount))) == pytest.approx(degrees, abs=1e-4)
    note = beam_note(whole, (0.0, 0.0, 0.0, *mount))
    assert (f"points upward in the newest pose ({degrees:.0f} deg" in note) == (degrees > 91.0)


def test_the_status_and_the_log_name_a_beam_that_points_upward(
    make_service: Callable[..., Service], tmp_path: Path
) -> None:
    """GIVEN poses of a world with z down, then of one with z up THEN the status says it for the first."""
    service = make_service(kind="external", driver="range_min_m = 0.05\nrange_max_m = 0.3")
    service.start_logged(log := tmp_path / "log")
    up, down = (0.0, 0.0, 0.1, *LEVEL), (0.0, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0)
    with service.attach() as client:

        def text() -> str:
            return str(client.status()["main"]["text"])

        drive(client, lambda: client.status()["poses"] > 0, up, "a pose")
        service.cycles(200)
        assert "points upward" not in text()
        drive(client, lambda: "points upward" in text(), down, "the note")
        assert "points upward" in service.run("status").stdout
        assert "points upward" in json.loads(service.run("status", "--json").stdout)["main"]["text"]
        drive(client, lambda: "points upward" not in text(), up, "the note's end")
        drive(client, lambda: "points upward" in text(), down, "the note again")
    until(lambda: "points upward" not in service.run("status").stdout, "the note's end with the client")
    service.stop()
    assert log.read_text().count("points upward") == 1
