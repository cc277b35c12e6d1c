"""End a program that runs as a child of ours."""

from __future__ import annotations

import subprocess


def end_child(child: subprocess.Popen[str], number: int, timeout_s: float) -> str:
    """Send a signal to a child that still runs, wait for its end, kill it when that does not come.

    Parameters
    ----------
    child : subprocess.Popen     text mode, standard output piped
    number : int                 of the signal
    timeout_s : float            how long it may take [s]

    Returns
    -------
    str  its unread output
    """
    if child.poll() is None:
        child.send_signal(number)
    try:
        out, _ = child.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        child.kill()
        out, _ = child.communicate()
    return str(out)
