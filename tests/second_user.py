"""Do something as another user, in a forked child that has loaded everything already."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

NOBODY = 65534
# before a command: run it as NOBODY
AS_NOBODY = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")


class OtherUser:
    """A child that runs `work(self)` as another user without groups; `say` and `receive` pass JSON lines."""

    def __init__(self, work: Callable[[OtherUser], Any], uid: int = NOBODY) -> None:
        up, down = os.pipe(), os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            code = 1
            try:
                os.close(up[0])
                os.close(down[1])
                self._in, self._out = os.fdopen(down[0]), os.fdopen(up[1], "w")
                signal.alarm(120)
                os.setgroups([])
                os.setresgid(uid, uid, uid)
                os.setresuid(uid, uid, uid)
                self.say(work(self))
                code = 0
            except BaseException as e:
                self.say({"failed": f"{type(e).__name__}: {e}"})
            finally:
                os._exit(code)
        os.close(up[1])
        os.close(down[0])
        self._in, self._out = os.fdopen(up[0]), os.fdopen(down[1], "w")

    def say(self, value: Any) -> None:
        """Send one value."""
        self._out.write(json.dumps(value) + "\n")
        self._out.flush()

    def receive(self) -> Any:
        """The next value that the other side sent; None when it ended."""
        line = self._in.readline()
        return json.loads(line) if line else None

    def end(self) -> None:
        """Kill it."""
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        self._in.close()
        self._out.close()

    def __enter__(self) -> OtherUser:
        return self

    def __exit__(self, *exc: object) -> None:
        self.end()


def as_other_user(work: Callable[[OtherUser], Any], uid: int = NOBODY) -> Any:
    """Result of `work`, run as another user."""
    with OtherUser(work, uid) as child:
        return child.receive()


def outcome(action: Callable[[], Any]) -> str:
    """`done`, or the exception's class and text."""
    try:
        action()
    except Exception as e:
        return f"{type(e).__name__}: {e}"
    return "done"
