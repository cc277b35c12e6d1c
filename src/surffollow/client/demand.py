"""Result of `dev_vector()`: six numbers to add to a pose, and their validity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from surffollow.shm.layout_follow import STATUS_NAMES, VALID

STALE = 1 << 16  # set by the client: the service is silent, dead or restarted
_ZERO = (0.0,) * 6


def status_names(status: int) -> tuple[str, ...]:
    """The names of the status bits, e.g. ("VALID", "LIMITED").

    Parameters
    ----------
    status : int
        `Demand.status`

    Returns
    -------
    tuple of str
        names of the bits that are set

    Examples
    --------
    >>> from surffollow.client import status_names
    >>> status_names(0b100001)
    ('VALID', 'LIMITED')
    """
    names = tuple(n for i, n in enumerate(STATUS_NAMES) if status >> i & 1)
    return (*names, "STALE") if status & STALE else names


class Demand(Sequence[float]):
    """Demand on the end effector: x y z [m], rx ry rz [rad], to add to the pose of `pose_t_ns`.

    Attributes
    ----------
    valid : bool
        False: all six numbers are zero, do not move on their account
    age_ns : int
        time since the service computed it
    status : int
        bits, see `names`
    pose_t_ns : int
        timestamp of the pose it refers to; 0: none
    t_ns : int
        when it was computed, CLOCK_MONOTONIC
    cycle, epoch : int
        of the service

    Examples
    --------
    >>> from surffollow.client import Demand
    >>> raw = (2_000_000, 1_000_000, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0, 1, 7, 3)
    >>> demand = Demand(raw, age_ns=400_000, status=1)
    >>> demand.valid, demand[2], demand.pose_t_ns
    (True, 0.004, 1000000)
    >>> list(demand)
    [0.0, 0.0, 0.004, 0.0, 0.0, 0.0]
    """

    __slots__ = ("_raw", "age_ns", "status")

    def __init__(self, raw: tuple[int | float, ...], age_ns: int, status: int) -> None:
        # raw: t_ns, pose_t_ns, six demands, status, cycle, epoch as they lie in `Output`
        self._raw = raw
        self.age_ns = age_ns
        self.status = status

    @property
    def valid(self) -> bool:
        """Whether the demand may be used; False: all six numbers are zero."""
        return bool(self.status & VALID)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the status bits that are set; see `status_names`."""
        return status_names(self.status)

    @property
    def t_ns(self) -> int:
        """When the demand was computed, CLOCK_MONOTONIC [ns]."""
        return int(self._raw[0])

    @property
    def pose_t_ns(self) -> int:
        """Timestamp of the pose that the demand refers to [ns]; 0: none."""
        return int(self._raw[1])

    @property
    def cycle(self) -> int:
        """Number of the cycle of the service that computed the demand."""
        return int(self._raw[9])

    @property
    def epoch(self) -> int:
        """Number of the start of the service that computed the demand."""
        return int(self._raw[10])

    @property
    def vector(self) -> tuple[float, ...]:
        """The six numbers as a tuple."""
        return self._raw[2:8] if self.status & VALID else _ZERO

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return self.vector[index]

    def __iter__(self) -> Iterator[float]:
        return iter(self.vector)

    def __eq__(self, other: object) -> bool:
        return tuple(self) == tuple(other) if isinstance(other, Sequence) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        x, y, z, rx, ry, rz = self.vector
        return (
            f"Demand(xyz=({x:.6g}, {y:.6g}, {z:.6g}) m, rot=({rx:.6g}, {ry:.6g}, {rz:.6g}) rad, "
            f"{'|'.join(self.names) or '0'}, age {self.age_ns / 1e6:.3g} ms)"
        )
