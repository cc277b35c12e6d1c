"""A sensor of several that is dead is named by `surffollow status` of a running service."""

import contextlib
import threading
from collections.abc import Callable

from running_service import POSE, Service, until
from surffollow.errors import NotRunningError

DEAD = 'mode = "adaptive"\n[[driver.faults]]\nkind = "invalid"\nchannel = 1'


def test_the_status_names_a_dead_sensor(make_service: Callable[..., Service]) -> None:
    service = make_service(kind="simulated", driver="channels = 2", follow=DEAD).start()
    named = "SUSPECT (some sensors give no reading within the window (channel 1))"
    ended = threading.Event()
    with service.attach() as client:

        def send() -> None:
            while not ended.wait(0.005):
                with contextlib.suppress(NotRunningError):  # it stands still for a moment
                    client.ee_pos(POSE)

        # poses go on while `status` starts: other reasons would follow without them
        sender = threading.Thread(target=send)
        sender.start()
        try:
            until(lambda: named in service.run("status").stdout, "the reason")
        finally:
            ended.set()
            sender.join()
