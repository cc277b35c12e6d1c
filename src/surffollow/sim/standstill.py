"""Why a driven robot stands still: status bits and causes of a stop, reported and, after a time, an error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from surffollow.config.stop_causes import stop_names
from surffollow.errors import RefusedError, ServiceError

REPORT_AFTER_NS = 2_000_000_000  # a start and a reset take less
ASK_EVERY_NS = 100_000_000
STOPPED = "STOPPED"


class Answer(Protocol):
    """A request on its way (`surffollow.client.Ticket`)."""

    def done(self) -> bool: ...
    def result(self) -> Any: ...


class Stoppable(Protocol):
    """The part of `surffollow.client.Client` that names and resets a stop."""

    def output(self) -> dict[str, Any] | None: ...
    def reset_stop(self, *, wait: bool) -> Answer: ...


def say_nothing(_: str) -> None:
    """Report nothing."""


class Standstill:
    """Follows the demands of a robot that its service does not let move.

    Parameters
    ----------
    name : str
        of the service
    patience_s : float
        longest time without a valid demand of an attached service [s]; infinite: no end
    reset : bool
        reset a stop that is latched before the first valid demand
    report : callable
        gets a line where the reasons are new
    """

    def __init__(
        self,
        name: str,
        patience_s: float,
        reset: bool = False,
        report: Callable[[str], None] = say_nothing,
    ) -> None:
        self._name, self._patience_ns, self._report = name, patience_s * 1e9, report
        self._resets = reset
        self._since_ns = self._ask_ns = 0
        self._answer: Answer | None = None
        self._refusal = self._reported = ""
        self.error: ServiceError | None = None

    def moves(self) -> None:
        """Note a valid demand: a later stop is not reset."""
        self._resets, self._since_ns, self._answer, self._reported = False, 0, None, ""

    def stands(self, t_ns: int, names: tuple[str, ...], service: Stoppable) -> None:
        """Note a demand that is not valid; ask for the reset of a stop; `error` when it lasts too long.

        Parameters
        ----------
        t_ns : int
            now [ns]
        names : tuple of str
            status bits of the demand
        service : Stoppable
            the attachment
        """
        self._since_ns = self._since_ns or t_ns
        stopped = STOPPED in names
        if stopped and self._resets:
            self._ask(t_ns, service)
        waited_ns = t_ns - self._since_ns
        if waited_ns < min(REPORT_AFTER_NS, self._patience_ns):
            return
        output = service.output() if stopped else None
        causes = ", ".join(stop_names(int(output["stop"]))) if output else ""
        text = f"service {self._name!r} gives no valid demand: {'|'.join(names) or 'none published'}"
        text += f", stopped by {causes}" if causes else ""
        text += f" ({self._refusal})" if self._refusal else ""
        if waited_ns >= self._patience_ns:
            self.error = ServiceError(f"{text}, for {waited_ns * 1e-9:.3g} s; {self._remedy(stopped)}")
        elif text != self._reported:
            self._reported = text
            self._report(text)

    def _remedy(self, stopped: bool) -> str:
        if not stopped:
            return f"see surffollow status --name {self._name}"
        if self._resets:
            return f"a cause that is still present cannot be reset: surffollow status --name {self._name}"
        return f"only the pose's holder resets it: surffollow simulate --name {self._name} --reset-stop"

    def _ask(self, t_ns: int, service: Stoppable) -> None:
        """Ask for the reset again and again: the cause ends when the robot's poses arrive."""
        if self._answer is not None and self._answer.done():
            answer, self._answer = self._answer, None
            try:
                answer.result()
                self._refusal = ""
            except RefusedError as refused:
                self._refusal = str(refused)
        if self._answer is None and t_ns >= self._ask_ns:
            self._ask_ns = t_ns + ASK_EVERY_NS
            self._answer = service.reset_stop(wait=False)
