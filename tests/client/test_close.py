"""`close` beside calls of other threads: they end in ClosedError, and no slot and no pose stay behind."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from running_service import POSE, Service, until
from surffollow.client import Client
from surffollow.errors import ClosedError, SurffollowError

ROUNDS = 12
CALLS: dict[str, Callable[[Client], object]] = {
    "ee_pos": lambda client: client.ee_pos(POSE),
    "sf_reset": lambda client: client.sf_reset(0.1, wait=False),
    "stop": lambda client: client.stop("test", wait=False),
    "dev_vector": lambda client: client.dev_vector(),
    "dev_vector_into": lambda client: client.dev_vector_into(bytearray(88)),
    "status": lambda client: client.status(),
    "audit": lambda client: client.audit(),
}


def call_until_closed(call: Callable[[], object]) -> str:
    """Call again and again; the error that ended it."""
    while True:
        try:
            call()
        except ClosedError:
            return "closed"
        except SurffollowError:  # refused, or not there yet
            continue
        except BaseException as error:
            return repr(error)


def test_threads_of_a_client_that_is_closed_end_and_hold_nothing(service: Service) -> None:
    for k in range(ROUNDS):
        client, ends = service.attach(), dict.fromkeys(CALLS, "")
        client.claim_pose()

        def work(what: str, client: Client = client, ends: dict[str, str] = ends) -> None:
            ends[what] = call_until_closed(lambda: CALLS[what](client))

        threads = [threading.Thread(target=work, args=(what,)) for what in CALLS]
        for thread in threads:
            thread.start()
        time.sleep(0.002 * k)  # the calls go on meanwhile
        client.close()
        for thread in threads:
            thread.join(10.0)
        assert ends == dict.fromkeys(CALLS, "closed")
        with service.observe() as watcher:
            until(lambda w=watcher: w.status()["main"]["clients"] == 0, "the slot is free")
            until(lambda w=watcher: w.status()["main"]["pose_slot"] == -1, "the pose is free")


@pytest.mark.parametrize("how", ["ensure_slot", "await_slot", "reattach"])
def test_a_closed_client_gets_no_slot(service: Service, how: str) -> None:
    client = service.attach()
    client.close()
    with pytest.raises(ClosedError):
        {
            "ensure_slot": client.ensure_slot,
            "await_slot": lambda: client.await_slot(time.monotonic() + 1.0),
            "reattach": client.reattach,
        }[how]()
    client.close()  # again: nothing is left to close
