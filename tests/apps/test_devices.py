"""The paper's three resources: an arbiter declared in Python, and a controller process for each of them."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest
from click.testing import CliRunner

from running_service import until
from surffollow.apps.device_processes import CameraStatus, SpeakerStatus
from surffollow.arbiter import attach
from surffollow.blocks import mem_attach
from surffollow.cli.device import device_command
from surffollow.sim.devices import PanCamera, Speaker

ROOT = Path(__file__).parents[2]


def test_the_text_of_a_device_says_whose_commands_it_obeyed(monkeypatch):
    said = {"obeyed": {0: 3, 7: 40}, "pan_rad": 0.5, "moving": False}
    monkeypatch.setattr("surffollow.apps.device_processes.run_device", lambda *_: said)
    done = CliRunner().invoke(device_command, ["camera"])
    assert done.output == "cycles: 3 of the safe command, 40 of client 7; pan_rad 0.5, moving False\n"


def test_a_camera_turns_at_its_rate_and_stays_within_its_range():
    camera = PanCamera()
    camera.step(1.0, 0.25)
    assert (camera.pan_rad, camera.moving) == (0.25, True)
    for _ in range(10):
        camera.step(9.0, 0.25)
    assert (camera.pan_rad, camera.moving) == (math.pi / 2, False)
    camera.step(0.0, 0.25)
    assert camera.pan_rad == pytest.approx(math.pi / 2 - 0.25)


def test_a_speaker_counts_its_tones_and_what_is_not_heard_is_silence():
    speaker = Speaker()
    for desired in (440.0, 440.0, 880.0, 0.0, 5.0, float("nan"), 880.0):
        speaker.step(desired, 0.02)
    assert (speaker.tone_hz, speaker.tones) == (880.0, 3)
    speaker.step(float("nan"), 0.02)
    assert speaker.tone_hz == 0.0


@contextlib.contextmanager
def program(*words):
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def test_camera_and_speaker_obey_their_own_holders_and_are_safe_without_one():
    name = f"egor{uuid.uuid4().hex[:8]}"
    device = ("-m", "surffollow", "device")
    with (
        program(str(ROOT / "examples/arbiter/egor.py"), name) as server,
        program(*device, "camera", "--name", name, "--json") as camera,
        program(*device, "speaker", "--name", name, "--json") as speaker,
        attach(name, "look", timeout_s=60.0) as look,
        attach(name, "sing") as sing,
        mem_attach(
            {"camera_status": CameraStatus, "speaker_status": SpeakerStatus}, name, timeout_s=60.0
        ) as seen,
    ):
        assert look.status()["resources"]["camera"]["status_block"] == f"{name}.camera_status"
        pan, tone = look.resource("camera"), sing.resource("speaker")
        assert pan.request()
        assert tone.request()
        until(lambda: pan.command(0.3) and seen["camera_status"].latest()["pan_rad"] == pytest.approx(0.3))
        assert seen["camera_status"].latest()["client"] == look.number
        until(lambda: tone.command(440.0) and seen["speaker_status"].latest()["tone_hz"] == 440.0)
        tone.relinquish()
        until(lambda: seen["speaker_status"].latest()["tone_hz"] == 0.0)
        look.close()  # its end is enough: the camera looks ahead
        until(lambda: seen["camera_status"].latest()["pan_rad"] == 0.0)
        assert seen["camera_status"].latest()["client"] == 0
        ended = []
        for process in (camera, speaker):
            process.send_signal(signal.SIGTERM)
            ended.append(json.loads(process.communicate(timeout=60)[0]))
            assert process.returncode == 0
        assert ended[0]["obeyed"][str(look.number)] > 0
        assert ended[1]["tones"] == 1
        server.send_signal(signal.SIGTERM)
        assert server.wait(60) == 0
    assert not list(Path("/dev/shm").glob(f"{name}*"))
