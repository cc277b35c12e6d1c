"""A controller as a process of its own, for `bench_stop.py`: reports of the body in, commands out.

Each message is one datagram of the socket whose descriptor is the second word of the command line: from the
body int64 kind (0 report, 1 reset the stop), t_ns, seven float64; to the body int64 kind (1 follow, 0 hold),
pose_t_ns, float64 demand [m].
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
import time

from surffollow.client import Client, attach
from surffollow.errors import PoseError, SurffollowError

REPORT, COMMAND = struct.Struct("<qq7d"), struct.Struct("<qqd")
TICK_S = 0.01


def obey(client: Client, link: socket.socket) -> None:
    """One tick: reports to the service, its demand to the drives; whatever is wrong means hold."""
    follow, pose_t_ns, z = 0, 0, 0.0
    with contextlib.suppress(SurffollowError):
        with contextlib.suppress(BlockingIOError):
            while True:
                kind, t_ns, *pose = REPORT.unpack(link.recv(REPORT.size))
                if kind == 1:
                    client.reset_stop(timeout_s=1.0)
                else:
                    with contextlib.suppress(PoseError):  # it waited while this process was starting
                        client.ee_pos(pose, t_ns)
        demand = client.dev_vector()
        if demand.valid:
            follow, pose_t_ns, z = 1, demand.pose_t_ns, demand[2]
    with contextlib.suppress(BlockingIOError):
        link.send(COMMAND.pack(follow, pose_t_ns, z))


def main(name: str, fd: int) -> None:
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    link = socket.socket(fileno=fd)
    link.setblocking(False)
    client: Client | None = None
    wake = time.monotonic()
    while True:
        if client is None:
            try:
                client = attach(name)
                client.claim_pose()
                client.sf_reset(0.1)
            except SurffollowError:
                if client is not None:
                    client.close()
                client = None
        if client is not None:
            obey(client, link)
        wake = max(wake + TICK_S, time.monotonic())
        time.sleep(max(0.0, wake - time.monotonic()))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
