"""A sensor of several that is dead is named by `surffollow status` of a running service."""

from collections.abc import Callable

from running_service import Service, drive

# `status` takes some time to start, without a pose
DEAD = 'mode = "adaptive"\npose_timeout = "20 s"\n[[driver.faults]]\nkind = "invalid"\nchannel = 1'


def test_the_status_names_a_dead_sensor(make_service: Callable[..., Service]) -> None:
    service = make_service(kind="simulated", driver="channels = 2", follow=DEAD).start()
    named = "SUSPECT (some sensors give no reading within the window; the others count (channel 1))"
    with service.attach() as client:
        # a service that stood still for a moment says first that there was no reading at all
        drive(client, lambda: named in service.run("status").stdout, what="the reason")
