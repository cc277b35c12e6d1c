"""Parts of a scan path that a run followed: where it is continued, and how much of the region they cover."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.check_file import Poses
from surffollow.scan.check_raster import covered
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath

ID_DIGITS = 8
Parts = Sequence[Sequence[float]]


class FollowedParts:
    """Parts of a path's time that a robot has followed.

    Attributes
    ----------
    parts_s : list of [begin, end]   in order [s]
    """

    def __init__(self) -> None:
        self.parts_s: list[list[float]] = []
        self._ended = True

    def note(self, here_s: float, follows: bool) -> None:
        """Note where the robot is [s], and whether it follows the path there; else the part ends before."""
        if follows and self._ended:
            self.parts_s.append([here_s, here_s])
        elif follows:
            self.parts_s[-1][1] = here_s
        self._ended = not follows

    def end(self, here_s: float, follows: bool) -> None:
        """End a part, up to here [s] if the robot has followed so far."""
        if not self._ended:
            self.note(here_s, follows)
        self._ended = True


def path_id(path: ScanPath) -> str:
    """Digest of a path's samples and facts: another plan has another one."""
    digest = hashlib.sha256(json.dumps(path.facts, sort_keys=True).encode())
    for column in (path.t_s, path.position_m, path.normal, path.azimuth_rad, path.passes):
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()[:ID_DIGITS]


def continue_from(path: ScanPath, end_s: float) -> str:
    """TIME@ID, the value of `--from` that continues a run which followed a path up to `end_s` [s]."""
    return f"{math.floor(1e3 * end_s) / 1e3:.3f}s@{path_id(path)}"


def check_begin(path: ScanPath, from_s: float) -> None:
    """Refuse a time [s] that is not along the path.

    Raises
    ------
    ScanInputError
        before its begin, or at its end, where nothing is left to be run
    """
    end_s = float(path.t_s[-1] - path.t_s[0])
    if not 0.0 <= from_s < end_s:
        raise ScanInputError(
            f"a run cannot begin at {from_s:.6g} s; the path is from 0 to {end_s:.6g} s long"
        )


def covered_part(path: ScanPath, parts: Parts) -> float | None:
    """Part of the planned region within half a swath of the passes in some parts of a path.

    Parameters
    ----------
    path : ScanPath
    parts : sequence of (begin, end)   times along the path [s], from its first sample on

    Returns
    -------
    float or None
        as `scan check` counts the coverage of a plan; None: the path names no region or no swath, or the
        region has too many swaths to be counted
    """
    if "region_m" not in path.facts or "swath_m" not in path.facts:
        return None
    region = np.array(path.facts["region_m"], np.float64)
    rows = [_rows(path, begin, end) for begin, end in parts if end > begin]
    # a turn after each part: its last row is not joined to the first one of the next part
    position = np.vstack([np.vstack([place, place[-1:]]) for place, _ in rows]) if rows else np.zeros((0, 3))
    passes = np.concatenate([np.append(number, -1) for _, number in rows]) if rows else np.zeros(0)
    none = np.zeros(len(passes))
    poses = Poses(position, np.zeros((len(none), 4)), none, none.astype(np.int64), passes.astype(np.int64))
    unknown = np.full((1, 1), np.nan)  # a map, to tell missed cells from unknown ones
    found = covered(unknown, (0.0, 0.0), 1.0, poses, float(path.facts["swath_m"]), region)
    if found is None:
        return 0.0
    return found.part if found.cells else None


def _rows(path: ScanPath, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
    """Places (n, 3) [m] and passes (n,) of a part of a path: its ends, and the samples between them."""
    t = path.t_s - path.t_s[0]
    at = np.concatenate([[begin_s], t[(t > begin_s) & (t < end_s)], [end_s]])
    place = np.column_stack([np.interp(at, t, column) for column in path.position_m.T])
    before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    return place, path.passes[before].astype(np.float64)
