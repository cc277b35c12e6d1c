"""`stop` from anywhere: beside other requests, in a signal handler, by a client that drove before."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable

import pytest

from running_service import POSE, STANDOFF_M, Service, World, drive, quickest, until
from surffollow.client import Client
from surffollow.client.request_sender import RequestSender
from surffollow.errors import BusyError

Make = Callable[..., Service]


def stopped(client: Client) -> bool:
    return client.status()["stopped"] == ["request"]


def test_a_stop_in_a_signal_handler_is_in_force_wherever_it_interrupts(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    with service.attach() as client, service.attach() as other:
        # GIVEN a robot that follows, and a handler that stops it in the middle of any request
        drive(client, lambda: client.dev_vector().valid, what="a demand")
        own_post = RequestSender._post_request
        tickets = []

        def post_with_a_signal_in_between(self: RequestSender, *words: object) -> object:
            signal.raise_signal(signal.SIGALRM)
            return own_post(self, *words)  # type: ignore[arg-type]

        before = signal.signal(
            signal.SIGALRM, lambda *_: tickets.append(client.stop("by a signal", wait=False))
        )
        monkeypatch.setattr(RequestSender, "_post_request", post_with_a_signal_in_between)
        try:
            # WHEN a signal comes in the middle of a request
            client.sf_reset(STANDOFF_M)  # its answer comes though the signal came in between
        finally:
            signal.signal(signal.SIGALRM, before)
            monkeypatch.undo()
        # THEN it is stopped, the request is answered, and nothing waits for a lost one
        until(lambda: stopped(client), "the stop")
        assert tickets[0].result() >= 0
        assert quickest(lambda: client.stop("again"), 1) < 3.0, "nothing waits for a lost request"
        client._posting = True
        with pytest.raises(BusyError):
            client.sf_reset(STANDOFF_M)
        client._posting = False
        client.reset_stop()
        other.stop("\udcff is no Unicode, and prevents no stop")
        until(lambda: stopped(client), "the stop")
        client.reset_stop()


class Unspeakable:
    """A reason that has no text."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


@pytest.mark.parametrize(
    ("reason", "kept"),
    [
        (None, ""),
        (ValueError("joint 3"), "joint 3"),
        (7, "7"),
        (Unspeakable(), "Unspeakable"),
        ("x" * 200, "x" * 63),
        ("a\0b", "a b"),
        ("\udcff", "?"),
    ],
    ids=["None", "error", "number", "unspeakable", "long", "NUL", "surrogate"],
)
@pytest.mark.parametrize("slot", [True, False], ids=["slot", "no slot"])
def test_any_reason_stops_with_and_without_a_slot(
    service: Service, reason: object, kept: str, slot: bool
) -> None:
    with service.attach() as client:
        drive(client, lambda: client.dev_vector().valid, what="a demand")
        if not slot:
            client._release_slot()
        client.stop(reason)
        until(lambda: stopped(client), "the stop")
        until(
            lambda: any(e.get("reason", "-") == kept for e in client.audit()), "the reason in the trail", 5.0
        )
        drive(client, lambda: client._pose_held, what="the pose")
        client.reset_stop()


def test_who_drove_before_a_restart_and_does_not_now_stops_at_once(make_service: Make) -> None:
    """GIVEN two clients WHEN the service restarts and the second sends poses THEN the first stops it without
    the pose.
    """
    s = make_service(kind="simulated")
    s.world = world = World(s.name)
    over = threading.Event()
    try:
        with s.start().attach() as first, s.attach() as second:
            drive(first, lambda: first.dev_vector().valid, what="a demand")
            s.kill()
            s.start()
            drive(second, lambda: second.dev_vector().valid, what="a demand for another one")

            def send() -> None:
                while not over.wait(0.002):
                    second.ee_pos(POSE)

            driving = threading.Thread(target=send)
            driving.start()
            try:
                until(first.reattach, "the new service")
                until(first.ensure_slot, "a slot")
                asked: list[str] = []
                own_ask = first._claim_pose
                first._claim_pose = lambda: asked.append("pose") or own_ask()  # type: ignore[assignment, func-returns-value, return-value]
                first.stop("not mine any more")
                assert asked == [], "a stop needs no pose"
                assert stopped(second)
            finally:
                over.set()
                driving.join()
    finally:
        world.close()
