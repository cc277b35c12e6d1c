"""The low-level controllers of the simulated camera and speaker: obey the arbiter, publish a status block."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from surffollow.arbiter import command_reader
from surffollow.blocks import F64, I64, AttachedBlock, Block, mem_attach
from surffollow.sim.devices import PanCamera, Speaker

DEVICE_HZ = 50.0


class CameraStatus(Block):
    """State of a camera; NAME.camera_status."""

    t_ns = I64(unit="ns", doc="CLOCK_MONOTONIC")
    client = I64(doc="number of the client that it obeys, 0: none, the safe command")
    pan_rad = F64(unit="rad", doc="left positive")
    moving = I64()


class SpeakerStatus(Block):
    """State of a speaker; NAME.speaker_status."""

    t_ns = I64(unit="ns", doc="CLOCK_MONOTONIC")
    client = I64(doc="number of the client that it obeys, 0: none, the safe command")
    tone_hz = F64(unit="Hz", doc="0: silence")
    tones = I64(doc="begun so far")


DEVICES: dict[str, tuple[type[PanCamera] | type[Speaker], type[Block], tuple[str, ...]]] = {
    "camera": (PanCamera, CameraStatus, ("pan_rad", "moving")),
    "speaker": (Speaker, SpeakerStatus, ("tone_hz", "tones")),
}


def _publish(block: AttachedBlock, device: Any, fields: tuple[str, ...], client: int) -> None:
    with block.write() as status:
        status.t_ns, status.client = time.monotonic_ns(), client
        for field in fields:
            setattr(status, field, getattr(device, field))


def run_device(kind: str, name: str, seconds: float, stopped: Callable[[], bool]) -> dict[str, Any]:
    """Run the low-level controller of an arbiter's resource `camera` or `speaker`.

    Parameters
    ----------
    kind : str          a key of DEVICES; also the resource's name
    name : str          of the arbiter, and prefix of the status block
    seconds : float     how long; 0: until `stopped`

    Returns
    -------
    dict   obeyed (cycles by client number; 0: the safe command), and the device's state
    """
    make, schema, fields = DEVICES[kind]
    device, obeyed = make(), dict[int, int]()
    until = time.monotonic() + seconds if seconds > 0.0 else float("inf")
    memory = mem_attach({f"{kind}_status": schema}, name, write=True)
    with memory, command_reader(name, kind) as reader:
        before = due = time.monotonic()
        while due < until and not stopped():
            command = reader.latest()
            now = time.monotonic()
            device.step(command.values[0] if command.values else 0.0, now - before)
            before = now
            client = 0 if command.safe else command.client
            obeyed[client] = obeyed.get(client, 0) + 1
            _publish(memory[f"{kind}_status"], device, fields, client)
            due = max(due + 1.0 / DEVICE_HZ, now)
            time.sleep(max(0.0, due - time.monotonic()))
    return {"obeyed": obeyed, **{f: getattr(device, f) for f in fields}}
