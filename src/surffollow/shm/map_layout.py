"""Lay out the map object `NAME.map`: one header page, the grid pairs, the scratch of a refocus.

The object outlives the service. Only the service's map thread writes it; everyone else maps it
read-only. Numbers here are the memory format; what they mean is in docs/explanation/maps.md.
"""

from __future__ import annotations

import math

from surffollow.shm.schema import F64, I16, I64, U8, U32, U64, Schema

MAGIC = int.from_bytes(b"SURFMAP1", "little")
VERSION = 1
HEADER_BYTES = 4096
PAIR_BYTES = 6
DIRTY_TILES = 512
UNKNOWN = -32768
"""Height of a grid without a sample; known heights are -32767 … 32767."""
MAX_HEIGHT = 32767
FULL_COUNT = 255
MAX_REGION_M = 1e6
MIN_GRID_M, MAX_GRID_M = 1e-6, 1e4  # that a configuration or a refocus may ask for
DEFAULT_QUANTUM_M = 25.4e-6
QUANTUM_PER_STANDOFF = DEFAULT_QUANTUM_M / 0.1  # a service's own choice: the default where it is 0.1 m
DEFAULT_FINEST_GRID_M = 2.54e-3

# MapHeader.state
NO_MAP, READY, RESETTING, REFOCUSING, INSTALLING = range(5)
STATE_NAMES = ("no_map", "ready", "resetting", "refocusing", "installing")
# MapHeader.rounding
ROUND_UNBIASED, ROUND_PAPER = range(2)
ROUNDING_NAMES = ("unbiased", "paper")
# outcome of one sample (update_map)
UPDATED, OUTSIDE, CLIPPED, GATED, INVALID, NOT_READY = range(6)
# answers of map operations
OK, BAD_REGION, BUSY, NO_SCRATCH, TOO_SMALL, NOT_MAPPED, BAD_MAP = range(7)
ANSWER_NAMES = (
    "ok",
    "the region's sides must be positive, finite and at most 1e6 m",
    "another map operation is in progress",
    "the scratch is too small for rows of this length",
    "the map's memory is too small for these grids",
    "there is no map yet",
    "the map is not usable",
)


class MapHeader(Schema):
    """Everything needed to find, read and update a grid, and to finish a cut-off operation."""

    magic = U64(doc="'SURFMAP1', stored last when the object is made")
    version = U32(doc="of this layout")
    header_bytes = U32(doc="offset of the grid pairs")
    layout_hash = U64(doc="hash of MapHeader and GridPair")
    capacity_grids = I64(doc="grids that the object has room for")
    scratch_bytes = I64(doc="room for a refocus, behind the pairs")
    owner_pid = I64(doc="the process that writes the map")
    owner_epoch = I64(doc="its epoch")
    stop = I64(doc="causes of the service's latched stop: it outlives the service; 0: not stopped")

    generation = I64(align=64, doc="odd while the grids are being laid anew; readers check it twice")
    state = I64(doc="NO_MAP, READY, RESETTING, REFOCUSING, INSTALLING")
    nx = I64(doc="columns")
    ny = I64(doc="rows")
    grid_m = F64(unit="m", doc="side of a grid")
    x0_m = F64(unit="m", doc="outer corner of grid (0, 0)")
    y0_m = F64(unit="m", doc="outer corner of grid (0, 0)")
    inv_grid_per_m = F64(unit="1/m", doc="1 / grid_m")
    datum_m = F64(unit="m", doc="height of quantum 0")
    quantum_m = F64(unit="m", doc="height of one count")
    inv_quantum_per_m = F64(unit="1/m", doc="1 / quantum_m")
    datum_set = I64(doc="0: the next sample sets the datum")
    tile_shift = I64(doc="dirty tiles are squares of 2^tile_shift grids")
    tiles_x = I64(doc="dirty tiles per row of tiles")
    region_m = F64(4, unit="m", doc="the user's region: x_min, y_min, x_max, y_max")
    params_hash = I64(
        doc="of the service's parameters in force; 0: no client has held the pose, or its end was requested"
    )

    finest_grid_m = F64(align=64, unit="m", doc="finest grid that position accuracy allows")
    rounding = I64(doc="ROUND_UNBIASED or ROUND_PAPER")
    gate_m = F64(unit="m", doc="samples farther from the grid's mean are outliers; 0: no gate")
    gate_min_count = I64(doc="the gate needs this many samples of history")
    datum_auto = I64(doc="1: every reset takes its datum from the first sample")

    dither_seed = U64(align=64, doc="where the rounding sequence starts")
    dither_count = I64(doc="numbers of the sequence used so far")
    dither_offset = I64(doc="rotation of the running block of the sequence, 32 bits")
    samples = I64(doc="samples averaged into a grid")
    outside = I64(doc="samples beside the map")
    clipped = I64(doc="samples beyond the range of heights since the last MapReset; their grids are unknown")
    gated = I64(doc="samples refused as outliers")
    invalid = I64(doc="samples that were not finite")

    journal_op = I64(align=64, doc="state to finish after a cut-off, 0: none; stored last")
    journal_progress = I64(
        doc="phase·2^48 + pending·2^40 + done: one word, so that a cut sees all or nothing"
    )
    journal_forward = I64(doc="1: resample in the forward pass, 0: in the backward pass")
    journal_nx = I64(doc="the geometry to come; same fields as the header's")
    journal_ny = I64(doc="")
    journal_grid_m = F64(unit="m", doc="")
    journal_x0_m = F64(unit="m", doc="")
    journal_y0_m = F64(unit="m", doc="")
    journal_region_m = F64(4, unit="m", doc="")
    journal_datum_m = F64(unit="m", doc="")
    journal_datum_set = I64(doc="")
    journal_quantum_m = F64(unit="m", doc="")
    overlap_old = I64(4, doc="old columns from, to, rows from, to that the new map covers")
    overlap_new = I64(4, doc="new columns from, to, rows from, to that the old map covers")
    resets = I64(doc="MapResets finished")
    refocuses = I64(doc="MapRefocuses finished")
    installs = I64(doc="installed maps")
    rejected = I64(doc="cut-off operations that lost the map")

    dirty = U32(DIRTY_TILES, align=64, doc="updates per tile since the object was made, modulo 2^32")


class GridPair(Schema):
    """Two neighbouring grids: the paper's six bytes."""

    h = I16(2, doc="mean height in quanta above the datum; -32768: unknown")
    c = U8(2, doc="samples in the mean, saturating; 0 with a known height: a prior")


assert MapHeader.SIZE <= HEADER_BYTES, MapHeader.SIZE
assert GridPair.SIZE == PAIR_BYTES

LAYOUT_HASH = (MapHeader.HASH ^ (GridPair.HASH * 3)) & (2**64 - 1)


def pairs_of(capacity_grids: int) -> int:
    """Grid pairs for so many grids."""
    return (capacity_grids + 1) // 2


def scratch_bytes(columns: int) -> int:
    """Scratch that refocusing needs for rows of up to `columns` grids, old or new [bytes]."""
    return 112 * (columns + 64)


def default_scratch_columns(capacity_grids: int) -> int:
    """Row length that a map object's own scratch allows: aspect ratios up to 64:1, any below 4096 columns."""
    return min(capacity_grids, max(4096, 8 * math.isqrt(capacity_grids)))


def pairs_offset() -> int:
    """Byte offset of the grid pairs in the map object."""
    return HEADER_BYTES


def scratch_offset(capacity_grids: int) -> int:
    """Byte offset of the scratch in the map object, page-aligned."""
    end = HEADER_BYTES + PAIR_BYTES * pairs_of(capacity_grids)
    return -(-end // 4096) * 4096


def map_object_size(capacity_grids: int, scratch_columns: int | None = None) -> int:
    """Bytes of the map object, a multiple of the page.

    Parameters
    ----------
    capacity_grids : int
        1 … 1e9
    scratch_columns : int
        longest row that a refocus can handle; default: see `default_scratch_columns`
    """
    columns = default_scratch_columns(capacity_grids) if scratch_columns is None else scratch_columns
    return scratch_offset(capacity_grids) + -(-scratch_bytes(columns) // 4096) * 4096
