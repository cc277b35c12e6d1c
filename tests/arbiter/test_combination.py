"""Sums of demands: validity, one reported pose, limits; against a twin with matrices."""

from __future__ import annotations

import contextlib
import signal
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from running_service import until
from surffollow.arbiter import attach, command_reader
from surffollow.arbiter.combine import to_pose

SIX = '["x", "y", "z", "rx", "ry", "rz"]'
CONFIG = f"""
[clients]
follow = 10
avoid = 20
reflex = 90

[resources.follow]
command = {SIX}
safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
ttl = "200 ms"
[resources.offset]
command = {SIX}
safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
ttl = "200 ms"

[combine.tool]
parts = ["follow", "offset"]
low = [-0.05, -0.05, -0.05, -0.1, -0.1, -0.1]
high = [0.05, 0.05, 0.05, 0.1, 0.1, 0.1]
required = ["follow"]
"""


def pose_of(rng):
    q = Rotation.random(random_state=int(rng.integers(1 << 31))).as_quat()
    return np.concatenate([rng.normal(0.0, 1.0, 3), q])


@pytest.mark.parametrize("seed", range(40))
def test_a_demand_asks_for_the_same_pose_whatever_pose_it_is_relative_to(seed):
    rng = np.random.default_rng(seed)
    one, other = pose_of(rng), pose_of(rng)
    demand, out = np.zeros(8), np.zeros(8)
    demand[:3] = rng.normal(0.0, 0.1, 3)
    demand[3:6] = rng.normal(0.0, 1.0, 3) * rng.choice([1.0, 1e-9, 0.0])
    to_pose(demand, one, other, 6, np.zeros(12), out)
    np.testing.assert_allclose(other[:3] + out[:3], one[:3] + demand[:3], atol=1e-12)
    expected = Rotation.from_rotvec(demand[3:6]) * Rotation.from_quat(one[3:])
    got = Rotation.from_rotvec(out[3:6]) * Rotation.from_quat(other[3:])
    assert (expected.inv() * got).magnitude() < 1e-7
    assert np.linalg.norm(out[3:6]) <= np.pi + 1e-9


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    """A server with one combination, its clients and a reader of the sum."""
    from arbiter.arbiter_process import ArbiterProcess

    server = ArbiterProcess(tmp_path_factory.mktemp("tool"), CONFIG)
    try:
        server.start()
        yield server
    finally:
        server.purge()


@pytest.fixture
def parts(tool):
    with contextlib.ExitStack() as stack:
        enter = stack.enter_context
        follow = enter(attach(tool.name, "follow")).resource("follow")
        avoid = enter(attach(tool.name, "avoid")).resource("offset")
        yield follow, avoid, enter(command_reader(tool.name, "tool"))
        avoid.relinquish()  # a part that is lost would make the next sum safe


LEVEL = (0.0, 0.0, 0.0, 1.0)


def see(reader, expected, *sends):
    """Send until the sum is as expected; commands end with their time to live."""

    def look():
        for send in sends:
            send()
        c = reader.latest()
        return c if not c.safe and np.allclose(c.values, expected, atol=1e-12) else None

    return until(look)


def test_the_sum_is_relative_to_the_followers_pose_and_others_are_converted(parts):
    # GIVEN a follower and another client that each hold a part
    follow, avoid, reader = parts
    assert follow.request()
    assert avoid.request()
    reported = set()

    def follows():
        now = time.monotonic_ns()
        reported.add(now)
        follow.command(0.0, 0.0, -0.01, 0.0, 0.0, 0.0, ref_t_ns=now, ref_pose=(1.0, 2.0, 0.100, *LEVEL))

    def lifts(pose, ref):
        avoid.command(0.0, 0.0, 0.02, 0.0, 0.0, 0.0, ref_t_ns=ref, ref_pose=pose)

    # an offset to nothing in particular is added as it is
    got = see(reader, (0, 0, 0.01, 0, 0, 0), follows, lambda: lifts(None, 0))
    assert got.ref_t_ns in reported
    # one that counts from another pose is converted: 20 mm above 0.104 is 24 mm above 0.100
    got = see(
        reader,
        (0, 0, 0.014, 0, 0, 0),
        follows,
        lambda: lifts((1.0, 2.0, 0.104, *LEVEL), time.monotonic_ns()),
    )
    assert got.ref_t_ns in reported


def test_what_is_relative_to_a_pose_that_was_not_given_is_not_converted(parts):
    follow, avoid, reader = parts
    assert follow.request()
    assert avoid.request()
    now = time.monotonic_ns
    down, up = (0.0, 0.0, -0.01, 0.0, 0.0, 0.0), (0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
    place, pose = (1.0, 2.0, 0.1), (1.0, 2.0, 0.1, *LEVEL)
    # of one pose they are summed, whether it is given or not
    both = (0, 0, 0.01, 0, 0, 0)

    def at_one_time():
        t_ns = now()
        follow.command(*down, ref_t_ns=t_ns)
        avoid.command(*up, ref_t_ns=t_ns, ref_pose=pose)

    see(reader, both, at_one_time)
    for one, other in ((None, pose), (pose, None), ((*place, 0.0, 0.0, 0.0, 2.0), pose)):
        until(
            lambda one=one, other=other: (
                follow.command(*down, ref_t_ns=now(), ref_pose=one)
                and avoid.command(*up, ref_t_ns=now(), ref_pose=other)
                and reader.latest().safe
            )
        )
        deadline = time.monotonic() + 0.05  # and it stays so
        until(
            lambda one=one, other=other, deadline=deadline: (
                follow.command(*down, ref_t_ns=now(), ref_pose=one)
                and avoid.command(*up, ref_t_ns=now(), ref_pose=other)
                and (time.monotonic() > deadline or not reader.latest().safe)
            )
        )
        assert reader.latest().safe
        see(
            reader,
            both,
            lambda: follow.command(*down, ref_t_ns=now(), ref_pose=pose),
            lambda: avoid.command(*up, ref_t_ns=now(), ref_pose=pose),
        )


def test_limits_hold_for_the_sum(parts):
    # GIVEN two holders of parts
    follow, avoid, reader = parts
    assert follow.request()
    assert avoid.request()
    # WHEN their sum is beyond the limits, THEN it is limited
    got = see(
        reader,
        (0, 0, 0.05, 0, 0, 0),
        lambda: follow.command(0, 0, 0.04, 0, 0, 0),
        lambda: avoid.command(0, 0, 0.04, 0, 0, 0),
    )
    assert got.limited


def test_the_sum_is_valid_only_while_every_part_is(parts):
    follow, avoid, reader = parts
    assert follow.request()
    alone = (0, 0, 0.01, 0, 0, 0)
    see(reader, alone, lambda: follow.command(*alone))
    assert avoid.request()
    # it holds its part and says nothing: no sum
    until(lambda: follow.command(*alone) and reader.latest().safe)
    see(reader, (0, 0, 0.02, 0, 0, 0), lambda: follow.command(*alone), lambda: avoid.command(*alone))
    # it falls silent: no sum from the end of its time on
    until(lambda: follow.command(*alone) and reader.latest().safe)
    # it gives its part back: the rest is the sum
    avoid.relinquish()
    see(reader, alone, lambda: follow.command(*alone))
    # a required part without a holder: no sum
    assert avoid.request()
    follow.relinquish()
    until(lambda: avoid.command(*alone) and reader.latest().safe)
    assert reader.latest().values == (0.0,) * 6


@pytest.mark.parametrize("end", ["killed", "stopped", "detached"])
def test_a_part_that_was_lost_makes_the_sum_safe_until_it_is_claimed_again(tool, child, end):
    """GIVEN a follower that is lifted by another client WHEN that one dies THEN the tool is not sent down."""

    def lift(say):
        offset = attach(tool.name, "avoid").resource("offset")
        assert offset.request()
        say(b"h")
        while True:
            offset.command(0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
            time.sleep(0.005)

    alone = (0, 0, -0.01, 0, 0, 0)
    with attach(tool.name, "follow") as one, command_reader(tool.name, "tool") as reader:
        follow = one.resource("follow")
        assert follow.request()
        if end == "detached":
            with attach(tool.name, "avoid") as other:
                offset = other.resource("offset")
                assert offset.request()
                see(reader, (0, 0, 0.01, 0, 0, 0), lambda: follow.command(*alone),
                    lambda: offset.command(0.0, 0.0, 0.02, 0.0, 0.0, 0.0))  # fmt: skip
        else:
            lifter = child(lift)
            assert lifter.receive() == b"h"
            see(reader, (0, 0, 0.01, 0, 0, 0), lambda: follow.command(*alone))
            lifter.signal(signal.SIGKILL if end == "killed" else signal.SIGSTOP)
        # WHEN it is gone, the follower's demand alone never goes out
        ends = time.monotonic() + 1.0
        while time.monotonic() < ends:
            follow.command(*alone)
            command = reader.latest()
            assert command.safe or command.values[2] > 0.0, command
            time.sleep(0.002)
        assert reader.latest().safe
        # THEN a client that claims the part and gives it back acknowledges the loss
        with attach(tool.name, "reflex") as operator:
            offset = operator.resource("offset")
            assert offset.request()
            offset.relinquish()
            see(reader, alone, lambda: follow.command(*alone))
            follow.relinquish()
