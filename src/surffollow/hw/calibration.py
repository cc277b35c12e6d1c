"""Result of a calibration, as a file that `[driver] calibration = "…"` reads (JSON)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from surffollow.config.input_file import contents_are_read
from surffollow.config.toml_file import read_small
from surffollow.errors import ConfigError
from surffollow.hw.driver import Mount
from surffollow.shm.layout_follow import CHANNELS

VERSION = 1


class RangeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Indications of a channel's sensor and the true distances; linear between the rows.

    Attributes
    ----------
    channel : 0 to 7
    indicated : ascending; in what the driver gives without calibration, volts or metres
    range_m : distances, ascending or descending [m]
    """

    channel: int
    indicated: tuple[float, ...]
    range_m: tuple[float, ...]

    def __post_init__(self) -> None:
        n = len(self.indicated)
        if not 0 <= self.channel < CHANNELS or n < 2 or n != len(self.range_m):
            raise ConfigError(
                f"calibration table of channel {self.channel} has {n} indicated values and "
                f"{len(self.range_m)} distances; expected two or more of each, channel 0 to {CHANNELS - 1}"
            )
        steps = [b - a for a, b in zip(self.range_m, self.range_m[1:])]
        if not all(a < b for a, b in zip(self.indicated, self.indicated[1:])) or not (
            all(s > 0 for s in steps) or all(s < 0 for s in steps)
        ):
            raise ConfigError(f"calibration table of channel {self.channel} is not monotone")


class Calibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that was found; what is None was not calibrated.

    Attributes
    ----------
    tables : per channel
    latency_s : age of a distance at its conversion's timestamp [s]
    mounts : tool from sensor, per channel
    about : how it was found: methods, residuals, covariances
    """

    version: int = VERSION
    tables: tuple[RangeTable, ...] = ()
    latency_s: float | None = None
    mounts: tuple[Mount, ...] | None = None
    about: dict[str, Any] = {}


@contents_are_read()
def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration file.

    Raises
    ------
    InputFileError
        it cannot be read
    ConfigError
        it is of another version, or says something that cannot be
    """
    data = read_small(path, "calibration", ConfigError)
    try:
        found = msgspec.json.decode(data, type=Calibration)
    except ConfigError as error:
        raise ConfigError(f"calibration {path}: {error}") from None
    except msgspec.MsgspecError as error:
        raise ConfigError(
            f"{path} is no calibration: {error}; it is written by `surffollow calibrate`"
        ) from None
    if found.version != VERSION:
        raise ConfigError(
            f"calibration {path} has version {found.version}, expected {VERSION}; calibrate anew"
        )
    if found.latency_s is not None and not 0.0 <= found.latency_s <= 10.0:
        raise ConfigError(f"calibration {path}: latency_s is {found.latency_s} s, expected 0 to 10 s")
    return found


def save_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration file, all or nothing."""
    from surffollow.map.formats.atomic_file import replacing

    with replacing(path) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(calibration), indent=1) + b"\n")


def merged(path: str | Path, **found: Any) -> Calibration:
    """Contents of a file, or nothing when there is none, with the new results in their place."""
    old = load_calibration(path) if os.path.exists(path) else Calibration()
    about = {**old.about, **found.pop("about", {})}
    if "tables" in found:
        new = {t.channel: t for t in (*old.tables, *found["tables"])}
        found["tables"] = tuple(new[c] for c in sorted(new))
    return msgspec.structs.replace(old, about=about, **found)
