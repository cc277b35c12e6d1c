"""Formats of sensors from their public data sheets."""

from __future__ import annotations

from typing import Any

# Benewake TFmini Plus and TFmini-S, product manual, "data output format of serial port": 9 bytes, header
# 59 59, distance in cm, signal strength (below 100, or 65535: not reliable), temperature, low byte of the sum
_TFMINI: dict[str, Any] = {
    "baud": 115200,
    "range_min_m": 0.1,
    "range_max_m": 12.0,
    "format": {
        "header": "59 59",
        "length": 9,
        "value": {"offset": 2, "type": "u16le"},
        "unit": "cm",
        "limits": [{"offset": 4, "type": "u16le", "low": 100, "high": 65534}],
        "checksum": {"kind": "sum8", "offset": 8},
    },
}
# Dimetix DLS-C/FLS-C, technical reference manual, "command set": s0h tracks, an answer is gNh+xxxxxxxx in
# tenths of a millimetre, an error gN@Ezzz; 19200 baud, 7 data bits, even parity by default
_DIMETIX: dict[str, Any] = {
    "baud": 19200,
    "bytesize": 7,
    "parity": "E",
    "start_command": "s0h\r\n",
    "range_min_m": 0.05,
    "range_max_m": 65.0,
    "format": {
        "pattern": r"g[0-9][gh]\+(?P<range>[0-9]{8})",
        "no_target": r"g[0-9](@E[0-9]{3}|\?)",
        "unit": "0.1 mm",
    },
}
PRESETS: dict[str, dict[str, Any]] = {"benewake-tfmini": _TFMINI, "dimetix": _DIMETIX}
