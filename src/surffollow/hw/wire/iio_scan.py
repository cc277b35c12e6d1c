"""Scans of a Linux IIO device: elements, their places and their calibration, from sysfs."""

from __future__ import annotations

import contextlib
import re
import struct
from pathlib import Path

import msgspec

from surffollow.errors import DriverError
from surffollow.hw.driver import Eight

_TYPE = re.compile(r"(be|le):([us])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?")
SYSFS = "sys/bus/iio/devices"


class Element(msgspec.Struct, frozen=True):
    """One number of a scan: where it is and how it is written."""

    name: str
    index: int
    offset: int
    reader: struct.Struct
    shift: int
    bits: int
    signed: bool

    @property
    def dropped(self) -> int:
        """Low bits that a conversion's 24 have no room for."""
        return max(0, self.bits - 24 + (not self.signed))

    def value(self, scan: bytes, at: int) -> int:
        """Its raw value in a scan that begins at byte `at`."""
        raw = int(self.reader.unpack_from(scan, at + self.offset)[0]) >> self.shift
        raw &= (1 << self.bits) - 1
        return raw - (1 << self.bits) if self.signed and raw >> (self.bits - 1) else raw


def find_device(root: Path, expected: str) -> Path:
    """The directory of a device in sysfs, by its directory's or its own name.

    Raises
    ------
    DriverError
        there is none, or more than one of that name
    """
    base = root / SYSFS
    if (base / expected).is_dir():
        return base / expected
    names = {}
    for folder in sorted(base.glob("iio:device*")):
        with contextlib.suppress(OSError):
            names[folder] = (folder / "name").read_text().strip()
    found = [f for f, n in names.items() if n == expected]
    if len(found) != 1:
        there = ", ".join(f"{f.name} ({n})" for f, n in names.items()) or "none"
        many = "several devices" if found else "no device"
        raise DriverError(f"{many} '{expected}' under {base}; there are: {there}")
    return found[0]


def _number(folder: Path, *names: str) -> float | None:
    """The number in the first of these files that is there."""
    for name in names:
        with contextlib.suppress(FileNotFoundError):
            text = (folder / name).read_text().strip()
            try:
                return float(text)
            except ValueError:
                raise DriverError(f"{folder / name} is {text!r}, expected a number") from None
    return None


def calibration_of(folder: Path, input_name: str) -> tuple[float, float]:
    """Scale [V/count] and offset [counts] of an input; 1 mV and 0 where sysfs says nothing.

    The file of the input comes before the one that all inputs share.

    Raises
    ------
    DriverError
        a file holds no number
    OSError
        a file cannot be read
    """
    kind = re.sub(r"\d.*$", "", input_name)
    scale = _number(folder, f"in_{input_name}_scale", f"in_{kind}_scale")
    offset = _number(folder, f"in_{input_name}_offset", f"in_{kind}_offset")
    return (1e-3 if scale is None else 1e-3 * scale), (0.0 if offset is None else offset)


def scan_layout(folder: Path, expected: tuple[str, ...]) -> tuple[dict[str, Element], int]:
    """Elements of a scan by name, and its size in bytes, as the enabled ones are laid out.

    An element lies at a multiple of its own size, a scan at a multiple of its largest element's.
    """
    rows = []
    for name in (*expected, "timestamp"):
        stem = folder / "scan_elements" / f"in_{name}" if name != "timestamp" else (
            folder / "scan_elements" / "in_timestamp"
        )  # fmt: skip
        text = stem.with_name(stem.name + "_type").read_text().strip()
        match = _TYPE.fullmatch(text)
        if match is None:
            raise DriverError(f"{stem.name}_type is '{text}', expected like 'le:s12/16>>4'")
        order, sign, bits, storage, repeat, shift = match.groups()
        size = int(storage) // 8
        fits = 0 < int(bits) <= int(storage) - int(shift or 0)
        if size not in (1, 2, 4, 8) or (repeat or "1") not in ("0", "1") or not fits:
            raise DriverError(
                f"{stem.name}_type is '{text}': only single numbers of 8 to 64 bits can be read"
            )
        index_text = stem.with_name(stem.name + "_index").read_text().strip()
        if not index_text.isdecimal():
            raise DriverError(f"{stem.name}_index is '{index_text}', expected a whole number")
        index = int(index_text)
        code = ("<" if order == "le" else ">") + {1: "B", 2: "H", 4: "I", 8: "Q"}[size]
        rows.append((index, name, struct.Struct(code), int(shift or 0), int(bits), sign == "s"))
    at, largest, layout = 0, 1, {}
    for index, name, reader, shift, bits, signed in sorted(rows, key=lambda row: row[0]):
        at = -(-at // reader.size) * reader.size
        layout[name] = Element(name, index, at, reader, shift, bits, signed)
        at, largest = at + reader.size, max(largest, reader.size)
    return layout, -(-at // largest) * largest


def eight_channels(values: list[float]) -> Eight:
    a, b, c, d, e, f, g, h = (*values, *[values[-1]] * (8 - len(values)))
    return (a, b, c, d, e, f, g, h)
