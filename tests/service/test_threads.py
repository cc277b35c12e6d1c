"""One client in several threads: a restart of the service costs it no slot and not its pose."""

from __future__ import annotations

import threading
from collections.abc import Callable

from running_service import POSE, Service, config_text, until
from surffollow.errors import SurffollowError

THREADS = 6


def test_threads_that_find_the_service_restarted_claim_one_slot_together(
    tmp_path_factory, monkeypatch
) -> None:
    from surffollow.client import attachment, slot

    service = Service(tmp_path_factory.mktemp("threads"), config_text())
    try:
        service.start()
        with service.attach() as client:
            client.ee_pos(POSE)
            # every look may re-attach, and to get a slot takes long enough for others to come
            monkeypatch.setattr(attachment, "REATTACH_EVERY_NS", 0)
            monkeypatch.setattr(slot, "SlotRequest", slowly(slot.SlotRequest))
            over = threading.Event()
            wrong: list[BaseException] = []

            def work(number: int) -> None:
                while not over.wait(0.0005):
                    try:
                        if number == 0:
                            client.ee_pos(POSE)
                        else:
                            client.dev_vector()
                            client.reattach()
                    except SurffollowError:
                        pass  # nothing is there to take it, for a while
                    except BaseException as e:
                        wrong.append(e)
                        return

            threads = [threading.Thread(target=work, args=(k,)) for k in range(THREADS)]
            for thread in threads:
                thread.start()
            try:
                for _ in range(2):
                    epoch = client.epoch
                    service.kill()
                    service.start()
                    until(lambda old=epoch: client.epoch != old and client.alive(), "the new service")
                    reported = until(
                        lambda: (m := client.status()["main"])["pose_slot"] == client.slot and m, "the pose"
                    )
                    assert reported["clients"] == 1
            finally:
                over.set()
                for thread in threads:
                    thread.join()
            assert not wrong
            client.ee_pos(POSE)
    finally:
        service.purge()


def slowly(function: Callable[..., object]) -> Callable[..., object]:
    """The function, with time for other threads before it."""

    def slow(*args: object) -> object:
        threading.Event().wait(0.02)
        return function(*args)

    return slow
