"""Serial and IIO drivers: distances, stamps, faults, unplugging and plugging in again."""

from __future__ import annotations

import contextlib
import os
import random
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hw.wired_drivers import MS, made, ranges
from hw.wires import FRAME_FORMAT, LINE_FORMAT, WINDOW, FakeIio, Pty, frame, line
from running_service import until
from surffollow.errors import ConfigError
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.polled import GARBLED, RUNNING, SILENT, STOPPED, WAITING
from surffollow.hw.wire.iio_scan import Element


@pytest.fixture
def tty(tmp_path: Path) -> Iterator[Pty]:
    pytest.importorskip("serial")
    made = Pty(tmp_path)
    yield made
    made.unplug()


def serial(tty: Pty, form: dict, **more: object) -> Any:
    settings = {"kind": "serial", "port": str(tty.path), "format": form, "silence_s": 0.1, **WINDOW, **more}
    return made(settings)


def test_serial_frames_become_distances_with_stamps_before_their_arrival(tty: Pty) -> None:
    driver, queue = serial(tty, FRAME_FORMAT, baud=9600), ConversionQueue()
    driver.start(queue)
    try:
        # GIVEN a driver of a serial sensor
        until(lambda: driver.state != WAITING, "the port")
        # WHEN two frames arrive
        tty.write(frame(0.1))
        before_ns = time.monotonic_ns()
        tty.write(frame(0.2))
        until(lambda: len(queue) == 2, "two distances")
        # THEN they are distances, stamped with the begin of their frame
        now_ns = time.monotonic_ns()
        (_, _, first_m), (t_ns, _, second_m) = ranges(driver, queue)
        assert (first_m, second_m) == (pytest.approx(0.1), pytest.approx(0.2))
        frame_ns = round(8 * 10 * 1e9 / 9600)
        assert before_ns - frame_ns <= t_ns <= now_ns - frame_ns
    finally:
        driver.stop()
    assert driver.state == STOPPED


def test_serial_states_from_waiting_to_running_garbled_silent_unplugged_and_back(tty: Pty) -> None:
    driver, queue = serial(tty, LINE_FORMAT), ConversionQueue()
    # GIVEN a driver whose sensor is not plugged in
    tty.unplug()
    driver.start(queue)
    try:
        until(lambda: "No such file" in " ".join(driver.faults()), "the fault")
        assert driver.state == WAITING
        tty.plug()

        def sends(data: bytes, state: str) -> bool:
            tty.write(data)
            return driver.state == state

        # WHEN it sends lines, THEN the driver runs
        until(lambda: sends(line(0.1), RUNNING) and driver.faults() == [], "distances")
        # WHEN it sends rubbish, nothing, or is unplugged, THEN the driver says which
        until(lambda: sends(b"\xff\x00\x12rubbish\r\n", GARBLED), "rubbish told")
        assert "check baud rate, format and checksum" in driver.faults()[0]
        until(lambda: sends(line(0.2), RUNNING), "recovery")
        until(lambda: driver.state == SILENT, "silence told")
        assert "nothing was received" in driver.faults()[0]
        assert "silence_s is 100 ms" in driver.faults()[0]
        tty.unplug()
        until(lambda: driver.state == WAITING, "unplugging told")
        assert str(tty.path) in driver.faults()[0]
        # WHEN it is plugged in again, THEN its distances are new ones
        queue.drain()
        tty.plug()
        until(lambda: sends(line(0.3), RUNNING) and len(queue) > 0, "replugging")
        assert {round(r, 6) for _, _, r in ranges(driver, queue) if r is not None} == {0.3}
        assert driver.connections >= 2
    finally:
        driver.stop()


def test_two_hundred_faults_on_a_line_in_use_never_deliver_a_wrong_distance(tty: Pty) -> None:
    seed = 15
    rng = random.Random(seed)
    # GIVEN a driver of a serial sensor
    driver, queue = serial(tty, FRAME_FORMAT), ConversionQueue(1 << 14)
    driver.start(queue)
    sent = {round(0.1 + 0.001 * k, 3) for k in range(100)}
    faults = 0
    try:
        until(lambda: driver.state != WAITING, "the port")
        k = 0
        # WHEN frames are cut, changed, made up, and the line is unplugged
        while faults < 200:
            taken = len(queue)
            for _ in range(6):
                tty.write(frame(0.1 + 0.001 * (k % 100)))
                k += 1
            # the line loses what its reader does not take in time
            until(lambda taken=taken: len(queue) > taken, "the reader")
            bad = bytearray(frame(0.1 + 0.001 * (k % 100)))
            kind = rng.randrange(4)
            if kind == 0:
                del bad[rng.randrange(8) :]
            elif kind == 1:
                bad[rng.randrange(8)] ^= 1 << rng.randrange(8)
            elif kind == 2:
                bad = bytearray(rng.randbytes(rng.randrange(1, 30)))
            elif faults % 50 == 3:
                tty.unplug()
                until(lambda: driver.state == WAITING, "unplugging told")
                tty.plug()
                until(lambda: driver.state != WAITING, "replugging")
            tty.write(bytes(bad))
            faults += 1
        until(lambda: tty.write(frame(0.1)) or (len(queue) > 0 and driver.state == RUNNING), "running")
    finally:
        driver.stop()
    # THEN every distance that it delivers was sent
    got = [r for _, _, r in ranges(driver, queue)]
    assert len(got) > 500
    wrong = [r for r in got if r is None or round(r, 3) not in sent or abs(r - round(r, 3)) > 1e-6]
    assert wrong == [], f"seed {seed}"


def test_a_sensor_that_must_be_asked_gets_its_command_at_every_opening(tty: Pty) -> None:
    driver = serial(tty, {}, preset="dimetix", baud=19200)
    driver.start(ConversionQueue())
    try:
        got = bytearray()

        def asked() -> bool:
            with contextlib.suppress(BlockingIOError):
                got.extend(os.read(tty.master, 100))
            return b"s0h" in got

        until(asked, "the command")
    finally:
        driver.stop()


def test_an_extra_that_is_missing_is_named_with_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, module in (("serial", "serial"), ("can", "can")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ConfigError, match=rf"pip install '\.\[{kind}\]'"):
            made({"kind": kind})


@pytest.fixture
def adc(tmp_path: Path) -> Iterator[FakeIio]:
    device = FakeIio(tmp_path)
    yield device
    if device.folder.exists():
        device.unplug()


def iio(adc: FakeIio, **more: object) -> Any:
    settings = {
        "kind": "iio",
        "device": adc.name,
        "inputs": ["voltage0", "voltage1"],
        "root": str(adc.root),
        "metres_per_volt": 0.1,
        "metres_at_zero": 0.01,
        "silence_s": 0.1,
        **WINDOW,
    }
    return made(settings | more)


def test_iio_scans_become_distances_by_scale_offset_type_and_the_device_s_time(adc: FakeIio) -> None:
    driver, queue = iio(adc), ConversionQueue()
    driver.start(queue)
    try:
        # GIVEN a driver that has set up a converter
        until(lambda: driver.state != WAITING, "the device")
        folder = adc.folder
        for path, expected in {
            "scan_elements/in_voltage0_en": "1",
            "scan_elements/in_voltage2_en": "0",
            "scan_elements/in_timestamp_en": "1",
            "current_timestamp_clock": "monotonic",
            "buffer/enable": "1",
        }.items():
            assert (folder / path).read_text().strip() == expected, path
        # WHEN scans arrive, in pieces too
        t_ns = time.monotonic_ns() - 3 * MS
        data = adc.scan(2000, 1608, t_ns) + adc.scan(4095, -2000, t_ns + MS)
        adc.write(data[:21])  # a scan may come in pieces
        adc.write(data[21:])
        until(lambda: len(queue) == 4, "two scans of two inputs")
        # THEN they are distances at the device's own times
        got = ranges(driver, queue)
        assert [(t, c) for t, c, _ in got] == [(t_ns, 0), (t_ns, 1), (t_ns + MS, 0), (t_ns + MS, 1)]
        volts = [2000 * 0.5e-3, (1608 - 8) * 0.25e-3, 4095 * 0.5e-3, -2008 * 0.25e-3]
        assert [r for _, _, r in got] == pytest.approx([0.01 + 0.1 * v for v in volts])
    finally:
        driver.stop()
    # THEN the converter is off when the driver has stopped
    assert (folder / "buffer/enable").read_text() == "0"


def test_an_iio_device_that_vanishes_is_reported_and_found_again(adc: FakeIio) -> None:
    driver, queue = iio(adc), ConversionQueue()
    driver.start(queue)
    try:
        # GIVEN a driver that delivers distances
        until(lambda: adc.write(adc.scan(1000, 0)) or driver.state == RUNNING, "distances")
        # WHEN its device vanishes, THEN that is told
        adc.unplug()
        until(lambda: driver.state == WAITING, "unplugging told")
        until(lambda: "no device 'fakeadc'" in driver.faults()[0], "the fault's text")
        # WHEN it is there again, THEN distances come
        adc.plug()
        until(lambda: adc.write(adc.scan(1000, 0)) or driver.state == RUNNING, "replugging")
        until(lambda: driver.state == SILENT, "silence told")
    finally:
        driver.stop()


def test_an_iio_set_up_that_cannot_be_is_refused(adc: FakeIio) -> None:
    with pytest.raises(ConfigError, match=r"no device 'other'.*iio:device0 \(fakeadc\)"):
        iio(adc, device="other")
    with pytest.raises(ConfigError, match="in_voltage7_type"):
        iio(adc, inputs=["voltage7"])
    (adc.folder / "scan_elements/in_voltage0_type").write_text("le:u12/16X4>>4")
    with pytest.raises(ConfigError, match="only single numbers"):
        iio(adc)


@pytest.mark.parametrize(
    ("bits", "signed", "dropped"),
    [(23, False, 0), (24, False, 1), (24, True, 0), (32, False, 9), (32, True, 8)],
)
def test_iio_numbers_keep_every_bit_that_a_conversion_has_room_for(
    bits: int, signed: bool, dropped: int
) -> None:
    element = Element("voltage0", 0, 0, struct.Struct("<i" if signed else "<I"), 0, bits, signed)
    assert element.dropped == dropped
    least, most = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    for number in (least, -1 if signed else 1, 0, most):
        assert element.value(element.reader.pack(number), 0) == number
        assert -(1 << 23) <= number >> element.dropped < 1 << 23


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("in_voltage_scale", "0", "reports scale 0 and offset 0 of voltage0, .* look at in_voltage0_scale"),
        ("in_voltage_scale", "inf", "reports scale inf"),
        ("in_voltage_scale", "none", "in_voltage_scale is 'none', expected a number"),
        ("in_voltage1_offset", "nan", "offset nan of voltage1"),
        ("scan_elements/in_voltage0_type", "le:u12/16>>99", "only single numbers"),
        ("scan_elements/in_voltage0_index", "none", "_index is 'none', expected a whole number"),
    ],
)
def test_a_converter_that_reports_no_usable_numbers_is_refused(
    adc: FakeIio, file: str, text: str, says: str
) -> None:
    (adc.folder / file).write_text(text)
    with pytest.raises(ConfigError, match=says):
        iio(adc)


@pytest.mark.parametrize(
    "wrong",
    [
        {"metres_per_volt": float("nan")},
        {"metres_at_zero": float("inf")},
        {"latency_s": -0.1},
        {"silence_s": float("nan")},
        {"range_max_m": float("inf")},
        {"inputs": ["voltage0", "voltage0"]},
    ],
)
def test_settings_of_a_converter_that_cannot_be_are_refused(adc: FakeIio, wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong)).replace("range_max_m", "window")):
        iio(adc, **wrong)
