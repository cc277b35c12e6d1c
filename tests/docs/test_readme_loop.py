"""The README's control loop, as it is pasted: it follows, holds, and survives the service's end."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from hanging_socket import MANNERS, hanging
from running_service import PATIENT_S, POSE, Service, until
from surffollow.client import Client
from surffollow.errors import NotRunningError
from surffollow.sim.world_surface import WorldConfig

ROOT = Path(__file__).parents[2]


def test_the_loop_follows_holds_when_stopped_or_interrupted_and_goes_on(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert found is not None
    text = found[1].replace('attach("surf")', f'attach("{service.name}", stale_min_s={PATIENT_S})')
    monkeypatch.chdir(tmp_path)
    done: list[str] = []
    sent: dict[int, Any] = {}
    names: dict[str, Any] = {}
    stops = iter(range(10**9))

    def read_pose() -> tuple[int, tuple[float, ...]]:
        time.sleep(0.002)
        pose = (POSE[0] + 1e-6 * len(sent), *POSE[1:])
        sent[t_ns := time.monotonic_ns()] = pose
        return t_ns, pose

    def move_to(pose: Any, demand: Any) -> None:
        assert pose == sent[demand.pose_t_ns], "the pose that the demand names"
        assert demand.valid
        assert abs(demand[2]) <= 0.05
        done.append("move")

    def moving() -> bool:
        robot = names["robot"]
        if done.count("move") == 30 and next(stops) == 0:
            with service.attach() as other:
                other.stop("test")
            done.append("stop")
        if done[-5:] == ["hold"] * 5 and robot.status()["stopped"]:
            robot.reset_stop()
            done.append("reset")
        return done.count("move") < 60

    def ee_pos(self: Client, *words: Any) -> None:
        if done.count("move") == 50 and "raised" not in done:
            done.append("raised")
            raise NotRunningError("gone")
        own_ee_pos(self, *words)

    own_ee_pos = Client.ee_pos
    monkeypatch.setattr(Client, "ee_pos", ee_pos)
    names |= {
        "moving": moving,
        "read_pose": read_pose,
        "move_to": move_to,
        "hold": lambda: done.append("hold"),
    }
    try:
        exec(text, names)
    finally:
        names["robot"].close()
    assert done.index("stop") < done.index("reset")
    after = done[done.index("raised") + 1]
    assert after == "hold", "an exception is answered by the stop, too"
    assert (tmp_path / "ground.map").exists()
    with service.observe() as watcher:
        until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose's release")


class Arm:
    """The robot of the page's reader: it moves at 50 mm/s and within 0.2 m/s up and down."""

    def __init__(self) -> None:
        self.pose, self.over, self.held = [0.845, 0.55, 0.1, 0.0, 0.0, 0.0, 1.0], False, 0
        self.longest_s, self.answered_s = 0.0, time.monotonic()
        self.errors: list[float] = []
        self.field = WorldConfig().make()

    def moving(self) -> bool:
        now_s = time.monotonic()
        self.longest_s, self.answered_s = max(self.longest_s, now_s - self.answered_s), now_s
        return not self.over

    def read_pose(self) -> tuple[int, tuple[float, ...]]:
        time.sleep(0.01)
        return time.monotonic_ns(), tuple(self.pose)

    def move_to(self, pose: tuple[float, ...], demand: Any) -> None:
        self.pose[0] = min(self.pose[0] + 0.0005, 1.03)
        self.pose[2] += max(-0.002, min(0.002, pose[2] + demand[2] - self.pose[2]))
        self.errors.append(abs(self.pose[2] - self.field.height_m(*self.pose[:2]) - 0.1))

    def hold(self) -> None:
        self.held += 1


def test_the_loop_closes_over_the_simulated_sensor_and_survives_a_kill(tmp_path: Path) -> None:
    own = Service(tmp_path, "log_words = 65536\n[map]\ngrids = 20000\n")
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert code is not None
    text = code[1].replace('attach("surf")', f"attach({own.name!r})")
    text = text.replace('"ground.map"', repr(str(tmp_path / "ground.map")))
    arm = Arm()
    names = {"moving": arm.moving, "read_pose": arm.read_pose, "move_to": arm.move_to, "hold": arm.hold}
    try:
        own.start()
        loop = threading.Thread(target=exec, args=(text, names), daemon=True)
        loop.start()
        until(lambda: len(arm.errors) > 300, "three seconds of following")
        # the ground at 50 mm/s, some ticks late at most, on a busy machine
        assert sorted(arm.errors[100:])[len(arm.errors[100:]) // 2] < 1.5e-3
        assert max(arm.errors[100:]) < 10e-3, "the tool swings"
        own.kill()
        for manner in MANNERS:
            with hanging(own.name, manner):  # its replacement delays no period
                arm.longest_s, held = 0.0, arm.held
                until(lambda held=held: arm.held > held + 50, f"holding while the socket {manner}")
                assert arm.longest_s < 1.0, manner
        own.start()
        followed = len(arm.errors)
        until(lambda: len(arm.errors) > followed + 50, "following again")
        arm.over = True
        loop.join(60.0)
        assert not loop.is_alive()
        assert (tmp_path / "ground.map").exists()
    finally:
        arm.over = True
        own.purge()
