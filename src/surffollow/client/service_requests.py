"""Requests of a client to the service's cycle: restart the forecast, set parameters, stop.

Every request is one message in the client's slot. The service answers it between two cycles.
"""

from __future__ import annotations

import struct

from surffollow.client.push_range import RangePusher
from surffollow.client.requests import StopTicket, Ticket
from surffollow.errors import BusyError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.layout_follow import Params


class ServiceRequests(RangePusher):
    """An attachment that may send requests to the cycle; see `Client`."""

    def sf_reset(self, offset_m: float, *, timeout_s: float = 5.0, wait: bool = True) -> Ticket:
        """Restart the forecast with a desired stand-off (paper: SFReset); a latched stop stays.

        Parameters
        ----------
        offset_m : float
            stand-off [m]
        timeout_s : float
            how long to wait for the answer
        wait : bool
            False: return at once; `Ticket.result` waits

        Returns
        -------
        Ticket
            answered when the forecast begins anew; `result` waits and gives the answer

        Raises
        ------
        ConfigError
            outside the bounds of `offset_m`
        RefusedError
            another client sends the pose, or the stand-off is outside the sensor's window
        RequestTimeoutError
            no answer within `timeout_s`
        NotRunningError
            the service ended
        """
        from surffollow.config.params import check_param

        return self._ask(lb.RQ_SF_RESET, (check_param("offset_m", offset_m),), timeout_s, wait)

    def stop(self, reason: object = "", *, timeout_s: float = 5.0, wait: bool = True) -> Ticket:
        """Stop: from the next cycle on no demand is valid, until the pose's holder calls `reset_stop`.

        Any client may ask. docs/reference/protocol.md defines the duty of the robot's controller. This is no
        safety function: it needs the service, the controller and the machine between them.

        It may be called while another request is under way, and in a signal handler. Without a slot (just
        after a restart of the service) it waits for one, or raises as the other requests do.

        Parameters
        ----------
        reason : object
            for the audit trail: text, or what `str` makes of it; the first 63 bytes as UTF-8 are kept
        timeout_s, wait : float, bool
            as in `sf_reset`

        Returns
        -------
        Ticket
            answered when the stop is latched

        Examples
        --------
        >>> from surffollow.client import attach
        >>> with attach("surf") as robot:
        ...     robot.claim_pose()
        ...     _ = robot.stop("a person came near")
        ...     "STOPPED" in robot.dev_vector().names
        ...     _ = robot.reset_stop()
        True
        """
        self._store_stop()
        numbers = struct.unpack(f"<{ls.STOP_TEXT_WORDS}q", _reason_bytes(reason))
        try:
            return self._ask(lb.RQ_STOP, (), timeout_s, wait, numbers)
        except BusyError:  # of this thread itself: the stored request takes effect, only the reason is lost
            return StopTicket(self).settle(timeout_s, wait)

    def reset_stop(self, *, timeout_s: float = 5.0, wait: bool = True) -> Ticket:
        """Leave the latched stop; the forecast restarts with the stand-off in force (see `sf_reset`).

        After a restart of the service that is the configured one: `sf_reset` sets another.

        Parameters
        ----------
        timeout_s, wait : float, bool
            as in `sf_reset`

        Returns
        -------
        Ticket
            answered when the stop is left

        Raises
        ------
        RefusedError
            this client does not send the pose, or a cause that the configuration names is
            still there (the text says which)
        RequestTimeoutError, NotRunningError
            as `sf_reset`
        """
        return self._ask(lb.RQ_STOP_RESET, (), timeout_s, wait)

    def set_params(self, *, timeout_s: float = 5.0, wait: bool = True, **values: object) -> Ticket:
        """Change parameters, all or none.

        Parameters
        ----------
        timeout_s, wait : float, bool
            as in `sf_reset`
        values : numbers, or text with a unit
            new values by name: `set_params(interval_size="2 mm", range_size=5)`

        Returns
        -------
        Ticket
            answered when the values are in force

        Raises
        ------
        ConfigError
            unknown name, wrong unit, outside its bounds
        TypeError
            no name, or more than fit into one request
        RefusedError
            this client does not send the pose, or the values contradict each other
        RequestTimeoutError, NotRunningError
            as `sf_reset`

        Examples
        --------
        >>> from surffollow.client import attach
        >>> with attach("surf") as robot:
        ...     _ = robot.set_params(max_speed="0.2 m/s")         # SI numbers, or text with units
        ...     robot.params()["max_speed_mps"]
        0.2
        """
        from surffollow.config.params import check_param, names_given

        if not values:
            raise TypeError("set_params needs at least one name=value")
        if len(values) > ls.REQUEST_ARGS:
            raise TypeError(f"at most {ls.REQUEST_ARGS} parameters in one call, not {len(values)}")
        numbers = [Params.offset(full) // 8 for full in names_given(values)]
        checked = [check_param(n, v) for n, v in values.items()]
        ticket = self._ask(lb.RQ_SET_PARAMS, checked, timeout_s, wait, numbers)
        self._next_look_ns = self._next_life_ns = 0
        return ticket


def _reason_bytes(reason: object) -> bytes:
    """The reason of a stop as the bytes of the request; any object is one, and none prevents the stop."""
    try:
        text = "" if reason is None else str(reason)
    except Exception:
        text = type(reason).__name__
    size = 8 * ls.STOP_TEXT_WORDS
    return text.encode(errors="replace").replace(b"\0", b" ")[: size - 1].ljust(size, b"\0")
