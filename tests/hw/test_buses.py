"""Drivers on a CAN bus and with datagrams: order, time, who is listened to, what is lost."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

import pytest

from hw.wired_drivers import MS, made, ranges
from hw.wires import FRAME_FORMAT, LINE_FORMAT, WINDOW, datagrams, frame, line
from running_service import unique_name, until
from surffollow.errors import ConfigError
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.polled import GARBLED, RUNNING, SILENT, WAITING
from surffollow.hw.wire.udp import UdpConfig, _Received, is_own_address

IP_PKTINFO = 8  # the socket module has it from Python 3.14 on


def test_can_messages_are_stamped_before_their_receive_time_and_others_are_ignored() -> None:
    library = pytest.importorskip("can")
    name = unique_name()
    # distances in tenths of millimetres, two sensors
    form = {"length": 4, "value": {"offset": 0, "type": "u16be"}, "unit": "0.1 mm"}
    messages = [
        {"id": 0x10, "format": form},
        {"id": 0x18FF01, "extended": True, "channel": 1, "format": form},
    ]
    settings = {"kind": "can", "interface": "virtual", "bus": name, "messages": messages, "silence_s": 0.1}
    # GIVEN a driver of two sensors on a bus
    driver, queue = made({**settings, "bitrate": 50_000, **WINDOW}), ConversionQueue()
    driver.start(queue)

    def message(number: int, extended: bool, data: bytes) -> object:
        return library.Message(arbitration_id=number, data=data, is_extended_id=extended)

    try:
        until(lambda: driver.state != WAITING, "the bus")
        with library.Bus(channel=name, interface="virtual") as bus:
            until(lambda: driver.state == SILENT, "silence told")
            # WHEN their messages, another one's and a cut one arrive
            before_ns = time.monotonic_ns()
            bus.send(message(0x10, False, struct.pack(">HH", 1234, 0)))
            bus.send(message(0x11, False, struct.pack(">HH", 1111, 0)))
            bus.send(message(0x18FF01, True, struct.pack(">HH", 2345, 0)))
            bus.send(message(0x10, False, b"\x01"))
            until(lambda: len(queue) == 2 and driver._source.rejected == 1, "two distances, one rejected")
            now_ns = time.monotonic_ns()
        # THEN the two are distances, stamped with the begin of their frame
        got = ranges(driver, queue)
        assert [(c, r) for _, c, r in got] == [(0, pytest.approx(0.1234)), (1, pytest.approx(0.2345))]
        frame_ns = round(1e9 * (47 + 32) / 50_000)
        assert before_ns - frame_ns - MS <= got[0][0] <= now_ns - frame_ns + MS
    finally:
        driver.stop()


def test_a_can_bus_that_fails_is_reported_and_joined_again(monkeypatch: pytest.MonkeyPatch) -> None:
    library = pytest.importorskip("can")
    name = unique_name()
    settings = {"kind": "can", "interface": "virtual", "bus": name, **WINDOW}
    driver = made({**settings, "messages": [{"id": 1, "format": FRAME_FORMAT}]})
    driver.start(ConversionQueue())
    try:
        # GIVEN a driver on a bus
        until(lambda: driver.state != WAITING, "the bus")
        # WHEN the bus fails, THEN that is told
        with monkeypatch.context() as broken:

            def fails(self: object, timeout: float) -> None:
                raise library.CanOperationError("the adapter was pulled out")

            broken.setattr("can.interfaces.virtual.VirtualBus._recv_internal", fails)
            until(lambda: "pulled out" in " ".join(driver.faults()), "the fault")
        # WHEN it works again, THEN distances come
        with library.Bus(channel=name, interface="virtual") as bus:
            data = frame(0.1)
            until(
                lambda: (
                    bus.send(library.Message(arbitration_id=1, data=data, is_extended_id=False))
                    or driver.state == RUNNING
                ),
                "recovery",
            )
    finally:
        driver.stop()


def test_datagrams_give_distances_in_order_and_count_what_is_missing() -> None:
    form = {"length": 6, "value": {"offset": 2, "type": "f32le"}, "unit": "m"}
    settings = {
        "kind": "udp",
        "port": 0,
        "sender": "any",
        "format": form,
        "sequence": {"offset": 0},
        "silence_s": 0.5,  # after it, what came since the last distance tells GARBLED from SILENT
        **WINDOW,
    }
    driver, queue = made(settings), ConversionQueue()
    source = driver._source
    driver.start(queue)
    send = datagrams(lambda: source.port)
    try:
        # GIVEN a driver of a sensor that numbers its datagrams
        until(lambda: source.port != 0, "the socket")
        # WHEN they come with gaps, out of order, and cut
        for number, range_m in ((65535, 0.1), (0, 0.2), (3, 0.3), (2, 0.25), (4, 0.4)):
            send(struct.pack("<Hf", number, range_m))
        until(lambda: len(queue) == 4 and source.rejected == 1, "four distances")
        send(b"short")
        until(lambda: source.rejected == 2, "what is no datagram of this form")
        # THEN the newer ones are distances, and those that are missing are counted
        assert [r for _, _, r in ranges(driver, queue)] == pytest.approx([0.1, 0.2, 0.3, 0.4], abs=1e-6)
        assert source.missing == 2
        until(lambda: driver.state == GARBLED, "what came last told")
    finally:
        driver.stop()


def test_only_the_named_sender_is_listened_to() -> None:
    with contextlib.ExitStack() as stack:
        receiver, sensor, stranger = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)
        )
        for one in (receiver, sensor, stranger):
            one.bind(("127.0.0.1", 0))
        reported = "{}:{}".format(*sensor.getsockname())
        received = _Received(receiver, reported)
        # WHEN the named sender and a stranger send, THEN the stranger's datagram is refused
        sensor.sendto(b"true", receiver.getsockname())
        stranger.sendto(b"forged", receiver.getsockname())
        assert received.receive() == (b"true", "")
        found = "{}:{}".format(*stranger.getsockname())
        assert received.receive() == (b"forged", f"datagrams come from {found}, expected from {reported}")


@pytest.mark.parametrize("named", ["address", "address:port"])
def test_datagrams_of_strangers_take_no_room_in_the_queue_of_a_sensor(named: str) -> None:
    with contextlib.ExitStack() as stack:
        receiver, sensor, beside, elsewhere = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(4)
        )
        receiver.bind(("0.0.0.0", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.setblocking(False)
        to = ("127.0.0.1", receiver.getsockname()[1])
        for one, host in ((sensor, "127.0.0.2"), (beside, "127.0.0.2"), (elsewhere, "127.0.0.3")):
            one.bind((host, 0))
        strangers = [elsewhere] if named == "address" else [elsewhere, beside]
        sender = "127.0.0.2" if named == "address" else "{}:{}".format(*sensor.getsockname())
        received = _Received(receiver, sender)
        # GIVEN a sensor that was heard
        sensor.sendto(b"first", to)
        assert received.receive() == (b"first", "")
        # WHEN strangers send more than the queue holds, THEN the sensor's next datagram is received
        for stranger in strangers:
            for _ in range(100):
                stranger.sendto(b"forged", to)
        sensor.sendto(b"second", to)
        assert received.receive() == (b"second", "")
        with pytest.raises(BlockingIOError):
            received.receive()
        # AND of an address every port is heard
        if named == "address":
            beside.sendto(b"third", to)
            assert received.receive() == (b"third", "")


def test_a_sensor_that_changes_its_port_is_named_and_may_return(monkeypatch: pytest.MonkeyPatch) -> None:
    # GIVEN a sensor on one port of a machine that counts as another one
    monkeypatch.setattr(UdpConfig, "_check_sender", lambda config: None)
    monkeypatch.setattr("surffollow.hw.wire.udp.is_own_address", lambda host: False)
    with contextlib.ExitStack() as stack:
        before, after = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        )
        for one in (before, after):
            one.bind(("127.0.0.2", 0))
        sender = "{}:{}".format(*before.getsockname())
        settings = {"port": 0, "sender": sender, "format": LINE_FORMAT, "silence_s": 0.05, **WINDOW}
        source = made({"kind": "udp", **settings})._source
        source.open()
        stack.callback(source.close)
        to = ("127.0.0.1", source.port)

        def taken(sensor: socket.socket) -> bool:
            sensor.sendto(line(0.07), to)
            return bool(source.read(0.01))

        until(lambda: taken(before), "its first distance")
        # WHEN it sends from another one, THEN that is named when it has been silent for a while
        until(lambda: taken(after) or source.rejected, "the refusal")
        assert source.rejection == "datagrams come from {}:{}, expected from {}".format(
            *after.getsockname(), sender
        )
        # WHEN it returns, THEN it is heard
        until(lambda: taken(before), "its distances")


def test_the_fault_names_the_strangers_address_and_that_nothing_was_good() -> None:
    reported = "192.0.2.7:5000"  # of no machine
    settings = {
        "kind": "udp",
        "port": 0,
        "sender": reported,
        "format": LINE_FORMAT,
        "silence_s": 0.05,
        **WINDOW,
    }
    driver = made(settings)
    source, queue = driver._source, ConversionQueue()
    driver.start(queue)
    send = datagrams(lambda: source.port)
    try:
        until(lambda: driver.state == SILENT, "silence")
        send(line(0.07))
        until(lambda: driver.state == GARBLED, "what came last told")
        (fault,) = driver.faults()
        assert "datagrams come from 127.0.0.1:" in fault
        assert f"expected from {reported}" in fault
        assert "(1 pieces rejected, none good)" in fault
        assert len(queue) == 0
    finally:
        driver.stop()


@pytest.mark.parametrize(
    "sender", ["", "192.0.2.7:0", "192.0.2.7:", "192.0.2.7:x", "0.0.0.0:5000", "224.0.0.1"]
)
def test_a_udp_sensor_without_a_sender_is_refused(sender: str) -> None:
    with pytest.raises(ConfigError, match="sender"):
        made({"kind": "udp", "port": 0, "sender": sender, "format": LINE_FORMAT, **WINDOW})


@pytest.mark.parametrize("sender", ["laser.example:5000", "laser", "192.0.2", "::1"])
def test_a_sender_that_is_no_address_is_refused_with_the_remedy(sender: str) -> None:
    with pytest.raises(ConfigError, match=r"sender = .* (IPv4 address|a port from 1)"):
        made({"kind": "udp", "port": 0, "sender": sender, "format": LINE_FORMAT, **WINDOW})


def test_a_program_can_send_in_the_name_of_a_bound_address_of_its_machine() -> None:
    """The reason why an address of this machine identifies no sender."""
    with contextlib.ExitStack() as stack:
        laser, service, forger = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)
        )
        laser.bind(("127.0.0.1", 0))
        service.bind(("127.0.0.1", 0))
        forger.bind(("127.0.0.2", laser.getsockname()[1]))
        packet_info = struct.pack("=i4s4s", 0, socket.inet_aton("127.0.0.1"), bytes(4))
        part = (socket.IPPROTO_IP, IP_PKTINFO, packet_info)
        forger.sendmsg([b"forged"], [part], 0, service.getsockname())
        assert service.recvfrom(64) == (b"forged", laser.getsockname())


@pytest.mark.parametrize("sender", ["127.0.0.1:5700", "127.0.0.1"])
def test_a_sender_of_this_machine_is_refused_and_the_remedies_are_named(sender: str) -> None:
    with pytest.raises(ConfigError, match=r'every local user can send.*"unix".*"external".*"any"'):
        made({"kind": "udp", "port": 0, "sender": sender, "format": LINE_FORMAT, **WINDOW})


def test_another_address_of_this_machine_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surffollow.hw.wire.udp.is_own_address", lambda host: host == "192.0.2.7")
    driver = made({"kind": "udp", "port": 0, "sender": "192.0.2.7:5700", "format": LINE_FORMAT, **WINDOW})
    driver.start(ConversionQueue())
    try:
        until(lambda: "every local user can send" in driver.faults()[0], "the fault")
    finally:
        driver.stop()


@pytest.mark.parametrize(
    ("sender", "host"), [("192.0.2.7", "0.0.0.0"), ("192.0.2.7:5700", "0.0.0.0"), ("any", "127.0.0.1")]
)
def test_without_a_host_a_sender_of_another_machine_is_received(sender: str, host: str) -> None:
    driver = made({"kind": "udp", "port": 0, "sender": sender, "format": LINE_FORMAT, **WINDOW})
    received = driver._source.bind()
    with received.socket as opened:
        assert opened.getsockname()[0] == host


def test_a_host_that_receives_from_no_sender_is_refused() -> None:
    loopback = {"kind": "udp", "port": 0, "host": "127.0.0.1", "sender": "192.0.2.7"}
    with pytest.raises(
        ConfigError, match=r"host = '127\.0\.0\.1' receives from no other machine.*leave host out"
    ):
        made({**loopback, "format": LINE_FORMAT, **WINDOW})


def test_only_addresses_of_this_machine_are_its_own() -> None:
    assert is_own_address("127.0.0.1")
    assert not is_own_address("192.0.2.7")


def test_a_udp_port_in_use_is_reported_until_it_is_free() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        # GIVEN a port in use, THEN that is told
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        driver = made({"kind": "udp", "port": port, "sender": "any", "format": LINE_FORMAT, **WINDOW})
        queue = ConversionQueue()
        driver.start(queue)
        until(lambda: any("cannot listen there" in f for f in driver.faults()), "the fault")
    try:
        # WHEN it is free, THEN distances come
        send = datagrams(lambda: port)
        until(lambda: send(line(0.123)) or len(queue) > 0, "a distance")
        assert ranges(driver, queue)[0][2] == pytest.approx(0.123)
    finally:
        driver.stop()


def test_a_sensor_that_counts_anew_counts_again_after_a_silence_and_a_repeated_datagram_does_not() -> None:
    form = {"length": 8, "value": {"offset": 4, "type": "f32le"}, "unit": "m"}
    sequence = {"offset": 0, "type": "u32le"}
    settings = {"kind": "udp", "port": 0, "sender": "any", "format": form, "sequence": sequence}
    driver, queue = made({**settings, "silence_s": 0.05, **WINDOW}), ConversionQueue()
    source = driver._source
    driver.start(queue)
    send = datagrams(lambda: source.port)
    try:
        # GIVEN a sensor at a high number
        until(lambda: source.port != 0, "the socket")
        send(struct.pack("<If", 1_000_000, 0.1))
        until(lambda: len(queue) == 1, "the first distance")
        # WHEN one datagram is repeated for longer than a silence, THEN it counts for nothing
        until(lambda: send(struct.pack("<If", 999, 0.2)) or driver.state == GARBLED, "the fault")
        rejected = source.rejected
        until(lambda: send(struct.pack("<If", 999, 0.2)) or source.rejected > rejected + 20, "more of it")
        assert len(queue) == 1
        # WHEN the sensor was switched off and on, THEN its second datagram is a distance
        send(struct.pack("<If", 1, 0.3))
        send(struct.pack("<If", 2, 0.31))
        send(struct.pack("<If", 3, 0.32))
        until(lambda: len(queue) == 3, "distances again")
        assert [r for _, _, r in ranges(driver, queue)] == pytest.approx([0.1, 0.31, 0.32], abs=1e-6)
        assert source.missing == 0
    finally:
        driver.stop()


def test_a_burst_of_late_datagrams_counts_for_nothing_while_newer_ones_come() -> None:
    form = {"length": 6, "value": {"offset": 2, "type": "f32le"}, "unit": "m"}
    settings = {"kind": "udp", "port": 0, "sender": "any", "format": form, "sequence": {"offset": 0}}
    driver, queue = made({**settings, "silence_s": 60.0, **WINDOW}), ConversionQueue()
    source = driver._source
    driver.start(queue)
    send = datagrams(lambda: source.port)
    try:
        until(lambda: source.port != 0, "the socket")
        for number in (100, 50, 51, 52, 53, 101):
            send(struct.pack("<Hf", number, 0.1))
        until(lambda: len(queue) == 2, "the newer ones")
        assert source.rejected == 4
    finally:
        driver.stop()


def test_a_number_beyond_all_counts_is_no_measurement_and_loses_no_device() -> None:
    form = {"length": 8, "value": {"offset": 0, "type": "f64le"}, "unit": "m"}
    driver = made({"kind": "udp", "port": 0, "sender": "any", "format": form, **WINDOW})
    source, queue = driver._source, ConversionQueue()
    driver.start(queue)
    send = datagrams(lambda: source.port)
    try:
        until(lambda: source.port != 0, "the socket")
        for range_m in (1e308, -1e308, 5e-324, float("nan"), 0.1):
            send(struct.pack("<d", range_m))
        until(lambda: len(queue) == 5, "all of them")
        assert [r for _, _, r in ranges(driver, queue)] == [None, None, 0.0, None, pytest.approx(0.1)]
        assert driver.connections == 1
    finally:
        driver.stop()


def test_a_flood_of_can_messages_that_give_nothing_does_not_keep_a_driver_from_ending() -> None:
    library = pytest.importorskip("can")
    settings = {"kind": "can", "interface": "virtual", "bus": unique_name(), **WINDOW}
    source = made({**settings, "messages": [{"id": 1, "format": FRAME_FORMAT}]})._source
    flood = [library.Message(arbitration_id=1, data=b"cut", is_extended_id=False)] * 10_000

    class Bus:
        """A bus that has a message whenever it is asked."""

        def recv(self, timeout_s: float) -> object:
            return flood.pop()

    source._bus = Bus()
    assert source.read(0.05) == []
    assert len(flood) > 9000


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"latency_s": -0.1}, "latency_s = -0.1, expected 0 to 10 s"),
        ({"latency_s": float("nan")}, "latency_s = nan"),
        ({"silence_s": float("inf")}, "silence_s = inf, expected 0.01 to 3600 s"),
        ({"silence_s": -1.0}, "silence_s = -1.0"),
        ({"sequence": {"offset": 0, "type": "f32le"}}, "sequence: type 'f32le' is no whole number"),
    ],
)
def test_settings_of_a_datagram_sensor_that_cannot_be_are_refused(wrong: dict, says: str) -> None:
    form = {"length": 8, "value": {"offset": 4, "type": "f32le"}, "unit": "m"}
    with pytest.raises(ConfigError, match=says):
        made({"kind": "udp", "port": 0, "sender": "any", "format": form, **WINDOW, **wrong})


def test_two_can_messages_for_one_channel_are_refused() -> None:
    pytest.importorskip("can")
    messages = [{"id": 1, "format": FRAME_FORMAT}, {"id": 2, "format": FRAME_FORMAT}]
    with pytest.raises(ConfigError, match=r"feed the same channel .*give each its own channel"):
        made({"kind": "can", "interface": "virtual", "bus": "x", "messages": messages, **WINDOW})
