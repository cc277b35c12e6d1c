"""A plant_tau that is far off is named: the learned time constant stands at an end of its range."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from running_service import Service, program, said, until
from surffollow import Follower
from surffollow.cli.service_notes import ServiceNotes
from surffollow.forecast.plant.plant_identification import time_constant_s
from surffollow.service.plant_note import TAU_AT_END, state_note, tau_note
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import N_PLANTS
from surffollow.shm.layout_follow import FollowState, Params

# a real service whose follower has learned a time constant at the upper end
FAR_OFF = """
import sys
import msgspec
from surffollow.config.service import load_config
from surffollow.service import daemon
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import FollowState
class Watch(daemon.PlantWatch):
    def __init__(self, params, state):
        far = zeros(FollowState)
        far[0]["scaled"]["time"] = 1.0
        plant = far[0]["adaptive"]["plant"]
        plant["tau_s"], plant["tau_configured_s"] = 0.134, 0.04
        super().__init__(params, far)
daemon.PlantWatch = Watch
daemon.serve(msgspec.structs.replace(load_config(sys.argv[1]), name=sys.argv[2]), quiet=True)
"""


def learned(real_s: float, told_s: float, standoff_m: float, seconds: float = 8.0) -> Follower:
    """A follower over waves with an axis of another time constant; lengths are in stand-offs."""
    config = {"plant": {"tau_s": told_s, "v_max_mps": 50.0 * standoff_m}, "memory": False}
    if standoff_m != 0.1:
        config["range_min"], config["range_max"] = 0.5 * standoff_m, 1.5 * standoff_m
    follower = Follower(config, offset_m=standoff_m)
    z_m = setpoint_m = reported_m = standoff_m
    for k in range(int(seconds / 1e-3)):
        x_m = 0.5 * standoff_m * k * 1e-3
        z_m += (setpoint_m - z_m) * 1e-3 / real_s
        if k % 10 == 0:
            follower.pose(k * 1_000_000, (x_m, 0.0, z_m, 0.0, 0.0, 0.0, 1.0))
            reported_m = z_m
        ground_m = 0.04 * standoff_m * np.sin(2.0 * np.pi * x_m / standoff_m)
        demand = follower.step(k * 1_000_000, [z_m - ground_m])
        if k % 10 == 5 and "VALID" in follower.state()["status"]:
            setpoint_m = reported_m + demand[2]
    return follower


@pytest.mark.parametrize(
    ("real_s", "told_s", "standoff_m", "is_noted"),
    [(0.04, 0.04, 0.1, False), (0.2, 0.04, 0.1, True), (0.006, 0.04, 0.1, True), (0.8, 0.16, 0.8, True)],
)
def test_the_note_stands_where_the_axis_is_far_from_its_configuration(
    real_s: float, told_s: float, standoff_m: float, is_noted: bool
) -> None:
    follower = learned(real_s, told_s, standoff_m, 8.0 * max(1.0, told_s / 0.04))
    note = state_note(follower._params, follower._state)
    assert note.startswith(TAU_AT_END) == is_noted, (note, follower.state()["tau_s"])
    if is_noted:
        assert f"plant_tau {1e3 * told_s:.3g} ms" in note
        assert "set plant_tau" in note


def test_the_ends_are_those_of_the_axis_models() -> None:
    plant = SimpleNamespace(tau_configured_s=0.04)
    low_s, high_s = (time_constant_s.py_func(plant, k) for k in (0, N_PLANTS - 1))
    for end_s, inwards in ((low_s, 1.16), (high_s, 0.84)):
        assert tau_note(end_s, 0.04)
        assert tau_note(end_s * (0.87 if end_s > 0.04 else 1.14), 0.04)
        assert not tau_note(end_s * inwards, 0.04)
    assert tau_note(0.0, 0.04) == tau_note(0.0, 0.0) == ""


def test_the_paper_mode_learns_no_time_constant() -> None:
    params, state = zeros(Params), zeros(FollowState)
    state[0]["scaled"]["time"] = 1.0
    plant = state[0]["adaptive"]["plant"]
    plant["tau_s"], plant["tau_configured_s"] = 0.134, 0.04
    assert state_note(params, state) == ""
    params["mode"] = 1
    assert state_note(params, state) != ""


def test_the_status_and_other_commands_show_the_note(
    make_service: Callable[..., Service],
) -> None:
    s = make_service()
    with program(FAR_OFF, str(s.config), s.name) as service:
        assert said(service).startswith("READY")
        with s.attach() as client:
            until(lambda: TAU_AT_END in client.status()["main"]["text"], "the note")
        for words in (("status",), ("check-robot", "--seconds", "1")):
            text = s.run(*words).stdout
            assert "note " in text
            assert f"{TAU_AT_END}, 134 ms, is at an end" in text, words
        notes = ServiceNotes(s.name)
        notes()
        assert notes.tau.startswith(TAU_AT_END)
        service.send_signal(signal.SIGTERM)
        assert service.wait(timeout=60) == 0
