"""The three resources of the paper's robot, declared as classes; this program is their arbiter.

python egor.py egor &
surffollow base --name egor & surffollow device camera --name egor & surffollow device speaker --name egor &
"""

import sys

from surffollow.arbiter.declaration import Declaration, Value, declare
from surffollow.arbiter.server import serve

CLIENTS = {"avoid": 40, "follow-wall": 30, "follow-wall-2": 20, "look": 15, "sing": 15, "go": 10}


class Robot(Declaration):
    """The base."""

    speed = Value("m/s", low=-0.5, high=0.5)
    turn_rate = Value("rad/s", low=-1.0, high=1.0)


class Camera(Declaration):
    """Looks aside while somebody wants it; a client that looks is asked before it loses the camera."""

    pan = Value("rad", low=-1.5, high=1.5)
    policy = "cooperative"


class Speaker(Declaration):
    """Sounds a tone; who comes last is heard."""

    tone = Value("Hz", low=0.0, high=20_000.0)
    equal = "newcomer"


if __name__ == "__main__":
    for declared, block in ((Robot, "base"), (Camera, "camera_status"), (Speaker, "speaker_status")):
        declared.status = f"{sys.argv[1]}.{block}"
    serve(declare(sys.argv[1], CLIENTS, [Robot, Camera, Speaker]))
