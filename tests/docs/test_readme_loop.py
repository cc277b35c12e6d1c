"""The controller's loop of the README, as it is pasted, against a real service."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest

from running_service import PATIENT_S, POSE, Service, until
from surffollow.client import Client
from surffollow.errors import NotRunningError

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
