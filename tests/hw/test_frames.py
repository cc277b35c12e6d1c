"""Measurements in bytes: what is found, what is rejected, and that rubbish never becomes a distance."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from hw.wires import FRAME_FORMAT, LINE_FORMAT, frame, line
from surffollow.errors import ConfigError
from surffollow.hw.wire import frame_format
from surffollow.hw.wire.frame_format import Format
from surffollow.hw.wire.frames import make_finder
from surffollow.hw.wire.presets import PRESETS
from surffollow.hw.wire.serial_port import SerialConfig, with_preset

import msgspec  # isort: skip

LINES, FRAMES = (msgspec.convert(f, Format) for f in (LINE_FORMAT, FRAME_FORMAT))
NMEA = Format(
    pattern=r"\$(?P<body>D,(?P<channel>[0-9]),(?P<range>[0-9.]{7}),(?P<status>[AV]))\*(?P<check>[0-9A-F]{2})",
    line_checksum="xor8",
    status_ok=("A",),
    unit="mm",
)


def nmea(channel: int, range_mm: float, status: str = "A") -> bytes:
    body = f"D,{channel},{range_mm:07.2f},{status}".encode()
    return b"$" + body + f"*{frame_format.xor8(body):02X}\r\n".encode()


def found(form: Format, data: bytes, piece: int = 0) -> list:
    finder = make_finder(form)
    pieces = [data[k : k + piece] for k in range(0, len(data), piece)] if piece else [data]
    return [m for p in pieces for m in finder.feed(p)]


@pytest.mark.parametrize(("form", "write"), [(LINES, line), (FRAMES, frame)], ids=["lines", "frames"])
def test_the_same_measurements_are_found_however_the_input_is_cut(form: Format, write) -> None:
    ranges = [0.1 + 0.001 * k for k in range(40)]
    data = b"".join(write(r) for r in ranges)
    lost = 1 if form is LINES else 0  # a first line may lack its beginning
    for piece in (0, 1, 3, 7, 64):
        got = [m[2] for m in found(form, data, piece)]
        assert got == pytest.approx(ranges[lost:], abs=1e-6), f"pieces of {piece}"


def test_a_measurement_says_how_long_ago_its_first_byte_came() -> None:
    data = b"".join(frame(0.1) for _ in range(3)) + b"\xaa"
    assert [m[0] for m in found(FRAMES, data)] == [25, 17, 9]
    text = b"".join(line(0.1) for _ in range(4)) + b"12"
    assert [m[0] for m in found(LINES, text)] == [29, 20, 11]


def test_after_rubbish_one_frame_alone_is_not_enough() -> None:
    data = frame(0.1) * 2 + b"\xaa\x55\x00" + frame(0.2) + b"\x01" + frame(0.3) + frame(0.301)
    assert [m[2] for m in found(FRAMES, data)] == pytest.approx([0.1, 0.1, 0.3, 0.301])


def test_checksums_are_the_published_ones() -> None:
    assert frame_format.crc16_modbus(b"123456789") == 0x4B37
    assert frame_format.crc16_ccitt(b"123456789") == 0x29B1
    assert frame_format.sum8(b"123456789") == 0xDD
    assert frame_format.xor8(b"123456789") == 0x31


def test_lines_with_channel_status_and_checksum() -> None:
    data = nmea(0, 1) + nmea(0, 100.5) + nmea(2, 200.25) + nmea(1, 150, "V") + nmea(3, 7.5)
    assert [(c, r) for _, c, r in found(NMEA, data)] == [
        (0, pytest.approx(0.1005)),
        (2, pytest.approx(0.20025)),
        (1, None),
        (3, pytest.approx(0.0075)),
    ]
    wrong = nmea(0, 1) + nmea(0, 100.5).replace(b"100", b"900")
    assert found(NMEA, wrong * 5) == []


def test_a_frame_that_says_no_target_or_a_bad_signal_is_no_measurement() -> None:
    config = msgspec.convert(
        with_preset({"port": "x", "preset": "benewake-tfmini", "range_max_m": 8.0}), SerialConfig
    )
    assert config.range_max_m == 8.0

    def tfmini(cm: int, strength: int) -> bytes:
        body = b"\x59\x59" + struct.pack("<HHH", cm, strength, 2500)
        return body + bytes([frame_format.sum8(body)])

    data = tfmini(150, 500) + tfmini(151, 99) + tfmini(152, 65535) + tfmini(153, 100)
    got = [r for _, _, r in found(config.format, data)]
    assert got == [pytest.approx(1.5), None, None, pytest.approx(1.53)]
    assert config.byte_ns == pytest.approx(1e9 * 10 / 115200)


def test_the_line_preset_knows_tenths_of_millimetres_errors_and_greetings() -> None:
    config = msgspec.convert(with_preset({"port": "x", "preset": "dimetix"}), SerialConfig)
    text = b"g0?\r\ng0h+00012345\r\ng0h+00012346\r\ng0@E255\r\ng0h+00012347\r\n"
    got = [r for _, _, r in found(config.format, text)]
    assert got == [pytest.approx(1.2345), pytest.approx(1.2346), None, pytest.approx(1.2347)]
    assert config.byte_ns == pytest.approx(1e9 * 10 / 19200)
    assert set(PRESETS) == {"benewake-tfmini", "dimetix"}


@pytest.mark.parametrize(("form", "write"), [(NMEA, None), (FRAMES, frame)], ids=["lines", "frames"])
def test_two_hundred_random_faults_never_become_a_wrong_distance(form: Format, write) -> None:
    seed = 15
    rng = np.random.default_rng(seed)
    true = [round(0.1 + 0.0001 * k, 4) for k in range(1000)]
    write = write or (lambda range_m: nmea(0, 1e3 * range_m))
    wrong, delivered = [], 0
    for fault in range(200):
        start = int(rng.integers(0, 900))
        data = bytearray(b"".join(write(r) for r in true[start : start + 40]))
        at = int(rng.integers(0, len(data) - 40))
        span = int(rng.integers(1, 40))
        kind = fault % 6
        if kind == 0:  # bytes lost
            del data[at : at + span]
        elif kind == 1:  # bytes of noise between
            data[at:at] = rng.bytes(span)
        elif kind == 2:  # bits flipped
            for k in range(at, at + span):
                data[k] ^= int(rng.integers(0, 256))
        elif kind == 3:  # stuck line
            data[at : at + span] = bytes([int(rng.choice([0, 255]))]) * span
        elif kind == 4:  # repeated piece
            data[at:at] = data[at : at + span]
        else:  # a wrong baud rate: nothing but noise
            data = bytearray(rng.bytes(len(data)))
        allowed = np.array(true[start : start + 40])
        for _, channel, range_m in found(form, bytes(data), int(rng.integers(1, 50))):
            delivered += 1
            if channel != 0 or (range_m is not None and abs(allowed - range_m).min() > 1e-6):
                wrong.append((fault, kind, range_m))
    assert wrong == [], f"seed {seed}"
    assert delivered > 3000


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({}, "either pattern"),
        ({"pattern": "([0-9]+)"}, "group named range"),
        ({"pattern": "(?P<range>["}, "regular expression"),
        ({"pattern": "(?P<range>.)", "unit": "kg"}, "unit"),
        ({"pattern": "(?P<range>.)", "unit": ""}, 'has no unit: .*unit = "1 mm", or "1 m" for metres'),
        ({"pattern": "(?P<range>.)", "line_checksum": "md5"}, "line_checksum"),
        ({"length": 8, "header": "zz"}, "hexadecimal"),
        ({"length": 2, "header": "aa 55"}, "length = 2"),
        ({"length": 8, "value": {"offset": 7}}, "does not lie within"),
        ({"length": 8, "value": {"offset": 0, "type": "u24"}}, "type 'u24' is unknown"),
        ({"length": 8, "checksum": {"kind": "md5", "offset": 7}}, "checksum kind"),
        ({"length": 8, "limits": [{"offset": 4, "type": "f32le", "mask": 3}]}, "'f32le' is no whole number"),
        ({"pattern": "(?P<range>.)", "unit": "0 m"}, "every number would be the same distance"),
        ({"pattern": "(?P<range>.)", "zero_m": float("nan")}, "zero_m = nan"),
    ],
)
def test_a_format_that_cannot_be_is_refused_with_what_could(settings: dict, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_finder(msgspec.convert({"unit": "mm"} | settings, Format))


def test_a_format_without_a_unit_is_no_metres() -> None:
    with pytest.raises(ConfigError, match="has no unit"):
        make_finder(msgspec.convert({"pattern": "(?P<range>.)"}, Format))


@pytest.mark.parametrize(
    ("form", "piece"),
    [
        ({"pattern": r"R(?P<range>[0-9]+)?"}, b"R"),
        ({"pattern": r"(?P<range>[0-9]+)(,(?P<channel>[0-9]))?"}, b"7"),
        ({"pattern": r"(?P<body>(?P<range>[0-9]+))([*](?P<check>..))?", "line_checksum": "xor8"}, b"7"),
        ({"length": 8, "channel": {"offset": 4, "type": "f32le"}}, struct.pack("<If", 7, np.nan)),
        ({"length": 8, "channel": {"offset": 4, "type": "f32le"}}, struct.pack("<If", 7, np.inf)),
    ],
    ids=["no range", "no channel", "no checksum", "channel NaN", "channel infinite"],
)
def test_a_piece_that_lacks_a_part_of_its_format_is_rejected_without_an_exception(
    form: dict, piece: bytes
) -> None:
    assert make_finder(msgspec.convert({"unit": "mm"} | form, Format)).parse(piece) is None
