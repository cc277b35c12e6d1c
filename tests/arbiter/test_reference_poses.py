"""Poses that the parts of a sum are relative to: no wrong one makes a part lead farther than its limits."""

from __future__ import annotations

import math
import re
import sys
import uuid
from typing import Any

import pytest

from surffollow.arbiter import command_reader, observe
from surffollow.arbiter import layout as al
from surffollow.arbiter import table as t
from surffollow.arbiter.combine import turn_between
from surffollow.arbiter.config import parse_config, reach
from surffollow.arbiter.effects import apply_event
from surffollow.arbiter.loop import enforce_deadlines
from surffollow.arbiter.mailbox import REF_AGE_NS, execute_item
from surffollow.arbiter.name_owner import purge_arbiter
from surffollow.arbiter.server import Server

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MS = 1_000_000
T0 = 10_000_000 * MS
TTL_NS = 250 * MS  # the default
SIX = '["x", "y", "z", "rx", "ry", "rz"]'
ZEROS = "safe = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"
# the offset may lift, and no more
CONFIG = f"""
[clients]
low = 10
high = 20
[resources.follow]
command = {SIX}
{ZEROS}
low = [-0.05, -0.05, -0.05, -0.1, -0.1, -0.1]
high = [0.05, 0.05, 0.05, 0.1, 0.1, 0.1]
[resources.offset]
command = {SIX}
{ZEROS}
low = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
high = [0.0, 0.0, 0.05, 0.0, 0.0, 0.0]
[combine.tool]
parts = ["follow", "offset"]
low = [-0.2, -0.2, -0.2, -0.5, -0.5, -0.5]
high = [0.2, 0.2, 0.2, 0.5, 0.5, 0.5]
"""
LEVEL = (0.0, 0.0, 0.0, 1.0)
POSE = (0.5, 0.5, 0.1, *LEVEL)
NONE, UP = (0.0,) * 6, (0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
FOLLOW, OFFSET = 0, 1  # resources, and the slots of their holders


class Sum:
    """A server whose loop does not run: its two parts are held, and the test sends at times of its own."""

    def __init__(self, text: str) -> None:
        self.server = Server(parse_config(tomllib.loads(f'name = "p{uuid.uuid4().hex[:10]}"\n{text}')))
        self.mem = self.server.mem
        self.seq = 0
        for part in (FOLLOW, OFFSET):
            self.mem.clients["live"][0, part] = 1
            self.mem.client_runs["number"][part] = part + 1
            apply_event(self.mem, part, t.RESTART, -1, 0, 0, T0)
            apply_event(self.mem, part, t.REQUEST, part, 0, 0, T0)
        self.server.board.set_state(al.STATE_READY)
        name = self.server.config.name
        self.seen, self.reader = observe(name), command_reader(name, "tool")
        self.history = self.seen.history()

    def send(self, part: int, values: Any, t_ns: int, ref_t_ns: int = 0, pose: Any = (0.0,) * 7) -> None:
        """One command of a part's holder, with a pose as it stands in the mailbox."""
        self.seq += 1
        item = self.mem.item[0]
        item["what"], item["seq"], item["t_ns"] = al.ITEM_COMMAND | part << 8, self.seq, t_ns
        item["token"], item["ref_t_ns"] = self.mem.machines["token"][part], ref_t_ns
        item["value"], item["ref_pose"] = (*values, *(0.0,) * (al.VALUES - len(values))), pose
        execute_item(self.mem, part, t_ns)

    def published(self, t_ns: int) -> tuple[int, tuple[float, ...], int]:
        """Source, values and flags of the sum in its command block."""
        enforce_deadlines(self.mem, t_ns)
        c = self.reader._block.latest().values
        return c.source, tuple(c.value[: c.n_values]), c.flags

    def events(self) -> list[str]:
        return [e.event for e in self.history]

    def waits(self) -> dict[str, str]:
        found = self.seen.status()["combinations"]["tool"]["waits_for"]
        return {w["part"]: w["reason"] for w in found}

    def close(self) -> None:
        self.reader.close()
        self.seen.close()
        self.server._connections.close()
        self.server._remove_objects()
        self.server._listener.close()
        purge_arbiter(self.server.config.name)  # the board stays while parts are held


@pytest.fixture
def make_sum():
    made = []

    def make(text=CONFIG):
        made.append(Sum(text))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def tool(make_sum):
    return make_sum()


def both(tool, pose, ref_ns=T0 - 10 * MS, lift=UP, of_follow=POSE):
    """A follower that demands nothing, and a lift relative to another pose."""
    tool.send(FOLLOW, NONE, T0, T0, of_follow)
    tool.send(OFFSET, lift, T0, ref_ns, pose)
    return tool.published(T0)


@pytest.mark.parametrize(
    "pose", [(0.5, 0.5, -9.9, *LEVEL), (0.5, 0.5, 10.1, *LEVEL), (0.7, 0.5, 0.1, *LEVEL)]
)
@pytest.mark.parametrize("swapped", [False, True])
def test_poses_farther_apart_than_any_part_leads_make_no_sum(tool, pose, swapped):
    """A part that may only lift led the tool down by 0.2 m."""
    poses = {"of_follow": pose, "pose": POSE} if swapped else {"pose": pose}
    assert both(tool, **poses) == (al.SOURCE_SAFE, NONE, 0)
    assert tool.waits() == {"offset": "pose"}
    # WHEN the poses agree again THEN the sum goes out, and waits for nothing
    assert both(tool, POSE)[0] == al.SOURCE_COMBINED
    assert tool.waits() == {}


def test_one_report_with_two_poses_makes_no_sum(tool):
    """GIVEN two poses of one timestamp, 5 m apart THEN one is wrong: they were added as if they agreed."""
    far = (5.5, 0.5, 0.1, *LEVEL)
    assert both(tool, far, ref_ns=T0) == (al.SOURCE_SAFE, NONE, 0)
    assert tool.waits() == {"offset": "pose"}
    # WHEN it differs by a rounding THEN the lift is converted, as between two reports
    source, values, _ = both(tool, (0.5, 0.5, 0.1 + 1e-6, *LEVEL), ref_ns=T0)
    assert source == al.SOURCE_COMBINED
    assert values == pytest.approx((0.0, 0.0, 0.02 + 1e-6, 0.0, 0.0, 0.0), abs=1e-9)
    # THEN the same pose, or the time alone, needs no conversion
    for pose in (POSE, (0.0,) * 7):
        assert both(tool, pose, ref_ns=T0) == (al.SOURCE_COMBINED, UP, 0)


def test_a_sum_is_as_old_as_its_oldest_command(tool):
    """Its time was that of the addition: a lift of 0.2 s ago looked new with each demand that was added."""
    tool.send(OFFSET, UP, T0)
    tool.send(FOLLOW, NONE, T0 + 200 * MS)
    source, values, _ = tool.published(T0 + 201 * MS)
    c = tool.reader._block.latest().values
    assert (source, values) == (al.SOURCE_COMBINED, UP)
    assert (c.t_ns, c.valid_until_ns) == (T0, T0 + TTL_NS)
    # the safe command is as old as its publication
    tool.published(T0 + TTL_NS)
    c = tool.reader._block.latest().values
    assert (c.source, c.t_ns) == (al.SOURCE_SAFE, T0 + TTL_NS)


def test_the_status_says_since_when_and_what_to_do(tool):
    both(tool, (0.5, 0.5, -9.9, *LEVEL))
    tool.send(OFFSET, UP, T0 + MS, T0 - 10 * MS, (0.5, 0.5, -9.9, *LEVEL))
    tool.published(T0 + MS)
    (wait,) = tool.seen.status()["combinations"]["tool"]["waits_for"]
    assert (wait["part"], wait["reason"], wait["since_ns"]) == ("offset", "pose", T0)
    assert "send the poses that the robot reported" in wait["remedy"]


@pytest.mark.parametrize(
    ("above_m", "z", "flags"),
    [(0.0, 0.02, 0), (0.004, 0.024, 0), (-0.03, 0.0, al.FLAG_LIMITED), (0.04, 0.05, al.FLAG_LIMITED)],
)
def test_a_converted_part_counts_within_its_own_limits(tool, above_m, z, flags):
    """GIVEN two poses apart by the way between two reports THEN the lift is converted and never descends."""
    source, values, got = both(tool, (0.5, 0.5, 0.1 + above_m, *LEVEL))
    assert (source, got) == (al.SOURCE_COMBINED, flags)
    assert values == pytest.approx((0.0, 0.0, z, 0.0, 0.0, 0.0))
    # along x the offset leads nowhere, whatever way the tool goes
    source, values, got = both(tool, (0.51, 0.5, 0.1 + above_m, *LEVEL))
    assert values == pytest.approx((0.0, 0.0, z, 0.0, 0.0, 0.0))
    assert got == al.FLAG_LIMITED


@pytest.mark.parametrize(("angle", "source"), [(0.19, al.SOURCE_COMBINED), (0.21, al.SOURCE_SAFE)])
def test_attitudes_farther_apart_than_any_part_turns_make_no_sum(tool, angle, source):
    turned = (0.5, 0.5, 0.1, 0.0, -math.sin(angle / 2), 0.0, -math.cos(angle / 2))
    got, values, _ = both(tool, turned)
    assert got == source
    assert values[3:] == (0.0,) * 3, "the offset may not turn the tool"


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 3.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_turn_between_two_attitudes(angle, sign):
    import numpy as np

    one = np.array([math.sin(0.35), 0.0, 0.0, math.cos(0.35)])
    other = sign * np.array([math.sin(0.35 + angle / 2), 0.0, 0.0, math.cos(0.35 + angle / 2)])
    assert turn_between(one, other, np.zeros(8)) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("z", [-1e300, 1.1e9, -1.1e9])
def test_a_pose_beyond_all_bounds_is_rejected(make_sum, z):
    """Without limits of the sum -1e300 left the server."""
    free = make_sum(re.sub(r"(?m)^(low|high) = \[.*$", "", CONFIG))
    assert both(free, (0.5, 0.5, z, *LEVEL))[0] == al.SOURCE_SAFE
    assert "REJECT_BAD" in free.events()


@pytest.mark.parametrize(
    ("ref_ns", "event"),
    [
        (T0 + 2 * MS, "REJECT_OLD"),
        (T0 - 360_000 * MS, "REJECT_OLD"),
        (T0 - TTL_NS - REF_AGE_NS, "REJECT_OLD"),
        (T0 - TTL_NS - REF_AGE_NS + 1, "FORWARD"),
        (-(1 << 63), "REJECT_OLD"),
        ((1 << 63) - 1, "REJECT_OLD"),
        (T0, "FORWARD"),
        (0, "FORWARD"),
    ],
)
def test_a_pose_of_the_future_or_of_long_ago_is_rejected(tool, ref_ns, event):
    tool.events()
    tool.send(OFFSET, UP, T0, ref_ns, POSE if ref_ns else (0.0,) * 7)
    assert tool.events() == [event]


@pytest.mark.parametrize(
    ("fields", "units"),
    [('["u", "v"]', ""), ('["x", "y", "z"]', 'units = ["mm", "mm", "mm"]'), ('["vx", "vy", "vz"]', "")],
)
def test_what_is_no_displacement_is_not_converted(make_sum, fields, units):
    n = fields.count(",") + 1
    zeros = f"safe = [{', '.join(['0.0'] * n)}]"
    parts = "".join(f"[resources.{p}]\ncommand = {fields}\n{units}\n{zeros}\n" for p in ("follow", "offset"))
    text = f'[clients]\nlow = 10\nhigh = 20\n{parts}[combine.tool]\nparts = ["follow", "offset"]\n'
    speeds = make_sum(text)
    ones = (1.0,) * n

    def send(ref_ns):
        speeds.send(FOLLOW, ones, T0, T0, POSE)
        speeds.send(OFFSET, ones, T0, ref_ns, (0.5, 0.5, 0.104, *LEVEL))
        return speeds.published(T0)[:2]

    # without a pose, or relative to the same one, they are added; another pose has no meaning for them
    assert send(0) == (al.SOURCE_COMBINED, (2.0,) * n)
    assert send(T0) == (al.SOURCE_COMBINED, (2.0,) * n)
    assert send(T0 - MS) == (al.SOURCE_SAFE, (0.0,) * n)
    assert speeds.waits() == {"offset": "pose"}


def test_the_reach_is_the_widest_range_of_any_part_within_that_of_the_sum():
    config = parse_config(tomllib.loads(CONFIG))
    assert reach(config, config.combine["tool"]) == pytest.approx((0.1, 0.2))
    narrow = CONFIG.replace("low = [-0.2, -0.2, -0.2", "low = [-0.01, -0.01, -0.01")
    narrow = narrow.replace("high = [0.2, 0.2, 0.2", "high = [0.01, 0.01, 0.02")
    config = parse_config(tomllib.loads(narrow))
    assert reach(config, config.combine["tool"]) == pytest.approx((0.03, 0.2))
