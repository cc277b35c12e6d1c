"""README's control loop, pasted: it closes the loop, and survives the service's end and its new start."""

from __future__ import annotations

import re
import threading
from pathlib import Path

from running_service import Service, until
from surffollow.sim.world_surface import WorldConfig

README = Path(__file__).parents[2] / "README.md"


class Arm:
    """What a reader of the page brings: a robot that moves at 50 mm/s and within 0.2 m/s up and down."""

    def __init__(self) -> None:
        self.pose, self.over, self.held, self.errors = [0.845, 0.55, 0.1, 0.0, 0.0, 0.0, 1.0], False, 0, []
        self.field = WorldConfig().make()

    def moving(self) -> bool:
        return not self.over

    def read_pose(self) -> tuple[float, ...]:
        return tuple(self.pose)

    def move_to(self, z_m: float) -> None:
        self.pose[0] = min(self.pose[0] + 0.0005, 1.03)
        self.pose[2] += max(-0.002, min(0.002, z_m - self.pose[2]))
        self.errors.append(abs(self.pose[2] - self.field.height_m(*self.pose[:2]) - 0.1))

    def hold(self) -> None:
        self.held += 1


def test_the_loop_of_the_first_page_follows_when_pasted(tmp_path: Path) -> None:
    service = Service(tmp_path, "log_words = 65536\n[map]\ngrids = 20000\n")
    code = re.search(r"```python\n(.*?)```", README.read_text(), re.S)
    assert code is not None
    text = code[1].replace('attach("surf")', f"attach({service.name!r})")
    text = text.replace('"ground.map"', repr(str(tmp_path / "ground.map")))
    arm = Arm()
    names = {"moving": arm.moving, "read_pose": arm.read_pose, "move_to": arm.move_to, "hold": arm.hold}
    try:
        service.start()
        loop = threading.Thread(target=exec, args=(text, names), daemon=True)
        loop.start()
        until(lambda: len(arm.errors) > 300, "three seconds of following")
        # the ground at 50 mm/s, some ticks late at most, on a busy machine
        assert sorted(arm.errors[100:])[len(arm.errors[100:]) // 2] < 1.5e-3
        assert max(arm.errors[100:]) < 10e-3, "the tool swings"
        service.kill()
        held = arm.held
        until(lambda: arm.held > held + 20, "holding while the service is away")
        service.start()
        followed = len(arm.errors)
        until(lambda: len(arm.errors) > followed + 50, "following again")
        arm.over = True
        loop.join(60.0)
        assert not loop.is_alive()
        assert (tmp_path / "ground.map").exists()
    finally:
        arm.over = True
        service.purge()
