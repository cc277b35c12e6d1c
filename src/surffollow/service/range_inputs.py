"""Pushed ranges: which client holds which channel, and what is taken from its slot in a cycle."""

from __future__ import annotations

from typing import Any

from surffollow.config.limits import ANY_USER
from surffollow.hw.pushed_ranges import PushedRanges, take_pushed
from surffollow.service import memory as m
from surffollow.service.slot_inputs import claim_of, slot_address
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit_pasted, jit_uncounted
from surffollow.shm.layout_board import (
    CLIENTS,
    ERR_NO_CHANNEL,
    ERR_NOT_ALLOWED,
    ERR_NOT_HOLDER,
    ERR_RANGE_HELD,
    OK,
    RQ_RELEASE_RANGE,
    Stats,
)
from surffollow.shm.layout_follow import CHANNELS, MAX_CONVERSIONS
from surffollow.shm.layout_slot import SLOT_RANGES

_CLAIMED = PushedRanges.offset("claimed_ns")
_RANGES = Stats.offset("ranges")
_REFUSED = Stats.offset("ranges_refused")
_SKIPPED = Stats.offset("ranges_skipped")


@jit_pasted
def any_held(ctx: Any) -> Any:
    """Whether any channel is held: asked first, for a call with the whole memory costs 100 ns."""
    return ctx[m.RANGES_HELD] != 0


@jit_uncounted
def _hold(mem: Any, channel: Any, slot: Any, t_ns: Any) -> None:
    """Give a channel to a slot, -1: to none."""
    ctx = mem.ctx
    bit = 1 << channel
    ctx[m.RANGES_HELD] = ctx[m.RANGES_HELD] & ~bit
    if slot >= 0:
        ctx[m.RANGES_HELD] = ctx[m.RANGES_HELD] | bit
        ctx[m.RANGE_CLAIM + channel] = claim_of(ctx, slot)
    at.store_release_i64(ctx.ctypes.data + 8 * (m.RANGE_SLOT + channel), slot)
    since = t_ns if slot >= 0 else 0
    at.store_release_i64(mem.pushed.ctypes.data + _CLAIMED + 8 * channel, since)


@jit_uncounted
def channels_of(ctx: Any, slot: Any) -> Any:
    """Bit per channel that the client in this slot pushes."""
    held = 0
    for c in range(CHANNELS):
        if (ctx[m.RANGES_HELD] >> c) & 1 and ctx[m.RANGE_SLOT + c] == slot:
            held |= 1 << c
    return held


@jit_uncounted
def may_push(ctx: Any, slot: Any) -> Any:
    """Whether this client's user may push ranges, which move the robot (access.ranges)."""
    user = at.load_relaxed_i64(ctx.ctypes.data + 8 * (m.UID + slot))
    return user in (0, ctx[m.OWN_USER], ctx[m.RANGES_BY]) or ctx[m.RANGES_BY] == ANY_USER


@jit_uncounted
def do_range_role(mem: Any, slot: Any, code: Any, t_ns: Any) -> Any:
    """CLAIM_RANGE and RELEASE_RANGE; (result, pid of the holder or number of channels).

    Parameters
    ----------
    mem : CycleMemory  `request` names the channel
    slot : int64  of the client
    code : int64  RQ_CLAIM_RANGE or RQ_RELEASE_RANGE
    t_ns : int64  now
    """
    ctx = mem.ctx
    channel = mem.request[0].number[0]
    if not 0 <= channel < mem.pushed[0].n_channels:
        return ERR_NO_CHANNEL, mem.pushed[0].n_channels
    is_held = (ctx[m.RANGES_HELD] >> channel) & 1 != 0
    mine = is_held and ctx[m.RANGE_SLOT + channel] == slot
    if code == RQ_RELEASE_RANGE:
        if not mine:
            return ERR_NOT_HOLDER, 0
        _hold(mem, channel, -1, t_ns)
        return OK, 0
    if mine:
        return OK, 0
    if not may_push(ctx, slot):
        return ERR_NOT_ALLOWED, 0
    if is_held:
        holder = ctx[m.RANGE_SLOT + channel]
        return ERR_RANGE_HELD, at.load_relaxed_i64(ctx.ctypes.data + 8 * (m.PID + holder))
    if channels_of(ctx, slot) == 0:  # ranges pushed before do not count
        ctx[m.RANGE_SEEN + slot] = at.load_acquire_i64(slot_address(ctx[m.SLOTS_AT], slot) + SLOT_RANGES)
    _hold(mem, channel, slot, t_ns)
    return OK, 0


@jit_uncounted
def drop_dead_range_holders(mem: Any, t_ns: Any) -> None:
    """Free the channels whose clients died or closed, from the kernel."""
    ctx = mem.ctx
    for c in range(CHANNELS):
        if (ctx[m.RANGES_HELD] >> c) & 1 == 0:
            continue
        if claim_of(ctx, ctx[m.RANGE_SLOT + c]) != ctx[m.RANGE_CLAIM + c]:
            _hold(mem, c, -1, t_ns)


@jit_uncounted
def _count(stats: Any, offset: Any, n: Any) -> None:
    at.store_relaxed_i64(stats + offset, at.load_relaxed_i64(stats + offset) + n)


@jit_uncounted
def drain_ranges(mem: Any, t_ns: Any) -> None:
    """Take what the holders pushed: in all no more than a cycle takes conversions, each an equal share."""
    ctx = mem.ctx
    slots, holders = 0, 0
    for c in range(CHANNELS):
        if (ctx[m.RANGES_HELD] >> c) & 1 == 0:
            continue
        bit = 1 << ctx[m.RANGE_SLOT + c]
        if slots & bit == 0:
            slots |= bit
            holders += 1
    for slot in range(CLIENTS):
        if (slots >> slot) & 1 == 0 or claim_of(ctx, slot) == 0:
            continue
        ring = slot_address(ctx[m.SLOTS_AT], slot) + SLOT_RANGES
        head, taken, refused, skipped = take_pushed(
            mem.pushed,
            ring,
            ctx[m.RANGE_SEEN + slot],
            channels_of(ctx, slot),
            MAX_CONVERSIONS // holders,
            t_ns,
        )
        ctx[m.RANGE_SEEN + slot] = head
        if taken + refused + skipped > 0:
            _count(ctx[m.STATS], _RANGES, taken)
            _count(ctx[m.STATS], _REFUSED, refused)
            _count(ctx[m.STATS], _SKIPPED, skipped)
