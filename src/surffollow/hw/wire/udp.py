"""Sensors that send datagrams over a network (kind = "udp"): one or several frames, or lines, in each."""

from __future__ import annotations

import ipaddress
import socket
import time
from typing import Any

from surffollow.config.key_errors import convert_table
from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import Driver, DriverInfo
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import RangeSettings
from surffollow.hw.wire.datagrams import DATAGRAM_BYTES, Datagrams, DatagramSource, bind_socket
from surffollow.hw.wire.frame_format import Format, Number, reader_of
from surffollow.hw.wire.sender_filter import admit_all, admit_only

ANY = "any"
# a program gives its datagrams any address of its machine (IP_PKTINFO), also when another one is bound to it
_OWN = (
    "is an address of this machine, in whose name every local user can send; let the program send to a Unix "
    'socket (kind = "unix") or push its ranges (kind = "external"), or admit every sender (sender = "any")'
)


class UdpConfig(RangeSettings, frozen=True, forbid_unknown_fields=True):
    """A sensor that sends datagrams.

    Attributes
    ----------
    port : to listen on
    host : address to listen on; "0.0.0.0": every one. Default: "0.0.0.0" for the `sender` of another machine,
        "127.0.0.1" for "any"
    sender : who is listened to: "address:port", "address" (every program there), or "any"; an address of
        another machine
    format : see `frame_format.Format`; a datagram holds whole frames or lines; a line may lack its terminator
    sequence : where a datagram's number is, if it is there; older ones than the last are dropped
    channels : sensors in the datagrams
    range_min_m, range_max_m, latency_s, mounts, silence_s : see `RangeSettings`
    """

    port: int
    host: str = ""
    sender: str = ""
    format: Format = Format()
    sequence: Number | None = None
    channels: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"port = {self.port}, expected 0 to 65535")
        if not self.sender:
            raise ConfigError(
                'sender is missing: a sender of ranges moves the robot; write "address:port" of the '
                'sensor, "address" for every program there, or "any"'
            )
        if self.sender != ANY:
            self._check_sender()
            if self.host.startswith("127.") or self.host == "localhost":
                raise ConfigError(
                    f"host = {self.host!r} receives from no other machine, and sender is {self.sender!r}; "
                    "leave host out, or give the address of this machine in the sensor's network"
                )
        if self.sequence is not None:
            reader_of(self.sequence, self.format.length, "sequence", whole=True)

    @property
    def address(self) -> tuple[str, int]:
        """Address and port to listen on."""
        return self.host or ("127.0.0.1" if self.sender == ANY else "0.0.0.0"), self.port

    def _check_sender(self) -> None:
        host, colon, port = self.sender.partition(":")
        if colon and not (port.isdigit() and 0 < int(port) <= 65535):
            raise ConfigError(f"sender = {self.sender!r}, expected a port from 1 to 65535 after the colon")
        try:
            address = ipaddress.IPv4Address(host)
        except ValueError:
            raise ConfigError(
                f"sender = {self.sender!r}, expected an IPv4 address like 192.168.0.7 before the port: names "
                f"are not looked up; write the sensor's address (getent ahostsv4 {host})"
            ) from None
        if address.is_unspecified or address.is_multicast:
            raise ConfigError(f"sender = {self.sender!r}: no datagram comes from {address}")
        if address.is_loopback:
            raise ConfigError(f"sender = {self.sender!r}: {address} {_OWN}")


class _Received:
    """Datagrams of one bound port; see `datagrams.Datagrams`.

    From the sender's first datagram on, those of others do not reach the queue: they could fill it.
    """

    def __init__(self, opened: socket.socket, sender: str) -> None:
        self.socket, self._sender = opened, sender
        self._filtered, self._accepted_s = False, 0.0

    def receive(self) -> tuple[bytes, str]:
        """The next datagram, and why its sender is refused."""
        data, (address, port) = self.socket.recvfrom(DATAGRAM_BYTES)
        if self._sender in (ANY, address, f"{address}:{port}"):
            self._accepted_s = time.monotonic()
            if not self._filtered and self._sender != ANY:
                admit_only(self.socket, self._sender)
                self._filtered = True
            return data, ""
        return data, f"datagrams come from {address}:{port}, expected from {self._sender}"

    def end_filter(self, silence_s: float) -> None:
        """Look at all datagrams again when the sender is silent for so long: who sends instead is named."""
        if self._filtered and time.monotonic() - self._accepted_s > silence_s:
            admit_all(self.socket)
            self._filtered = False


class UdpSource(DatagramSource):
    """The socket; see `polled.Source`."""

    def __init__(self, config: UdpConfig, info: DriverInfo) -> None:
        super().__init__("UDP port {}:{}".format(*config.address), config, info)
        self.port = config.port  # the one that was given, where 0 was asked for
        self._config = config
        self._received: _Received | None = None

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with their datagram's arrival as timestamp."""
        out = super().read(timeout_s)
        if not out and self._received is not None:
            self._received.end_filter(self._config.silence_s)
        return out

    def bind(self) -> Datagrams:
        """Bind the port; an address of this machine identifies no sender."""
        sender = self._config.sender
        host = sender.partition(":")[0]
        if sender != ANY and is_own_address(host):
            raise DriverError(f"sender = {sender!r}: {host} {_OWN}")
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        bind_socket(opened, self._config.address)
        self.port = opened.getsockname()[1]
        self._received = _Received(opened, sender)
        return self._received


def is_own_address(host: str) -> bool:
    """Whether an address is one of this machine: only such a one can be bound."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            return False
    return True


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make a UDP driver from its settings."""
    config = convert_table(settings, UdpConfig)
    info = config.info(f"sensor on UDP port {config.port}", config.channels)
    return PolledDriver(info, UdpSource(config, info), config.silence_s)
