"""Client library of robot controllers and observers: light (no NumPy, no numba).

from surffollow.client import attach

robot = attach("surf")
robot.sf_reset(0.1)
while moving:
    robot.ee_pos(pose, t_ns)
    demand = robot.dev_vector()     # zero and not valid when uncertain
"""

from __future__ import annotations

from surffollow.client.client import Client
from surffollow.client.demand import STALE, Demand, status_names
from surffollow.client.observer import DEMAND_BYTES, Observer
from surffollow.client.requests import Ticket

__all__ = [
    "DEMAND_BYTES",
    "STALE",
    "Client",
    "Demand",
    "Observer",
    "Ticket",
    "attach",
    "observe",
    "status_names",
]


def attach(
    name: str = "surf",
    *,
    stale_periods: int = 20,
    stale_min_s: float = 0.005,
    label: str = "",
    owner: int | str | None = None,
) -> Client:
    """Attach to a running service as a client that may send poses and requests.

    Parameters
    ----------
    name : str
        of the service
    stale_periods : int
        cycles of silence after which demands become zero
    stale_min_s : float
        but never sooner than this [s]
    label : str
        how the service's status names this client
    owner : int or str
        number or name of the user whose service to trust; None: this process's own
        user, root, or the one that SURFFOLLOW_OWNER names. Later services must have the owner of the first

    Returns
    -------
    Client
        to be closed, or used in a `with` statement

    Raises
    ------
    InvalidNameError
        (a ValueError) no name that a service can have
    NotRunningError
        no service of that name
    NoPermissionError
        not a member of the socket's group, or the service is another user's
    LayoutMismatchError
        the service is of another release
    BusyError
        all slots are taken, or as many as this user or process may have

    Examples
    --------
    >>> from surffollow.client import attach
    >>> with attach("surf", label="example") as robot:
    ...     robot.claim_pose()
    ...     [client["name"] for client in robot.clients()]
    ['example']
    """
    return Client(name, stale_periods=stale_periods, stale_min_s=stale_min_s, label=label, owner=owner)


def observe(
    name: str = "surf",
    *,
    stale_periods: int = 20,
    stale_min_s: float = 0.005,
    owner: int | str | None = None,
) -> Observer:
    """Attach read-only: no slot, no write permission needed; raises as `attach`.

    Parameters
    ----------
    name : str
        of the service
    stale_periods, stale_min_s, owner
        as for `attach`

    Returns
    -------
    Observer
        to be closed, or used in a `with` statement

    Examples
    --------
    >>> from surffollow.client import observe
    >>> with observe("surf") as watcher:
    ...     watcher.output()["cycle"] > 0, "offset_m" in watcher.params()
    (True, True)
    """
    return Observer(name, stale_periods=stale_periods, stale_min_s=stale_min_s, owner=owner)
