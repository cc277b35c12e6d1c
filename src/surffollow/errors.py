"""Every exception that surffollow raises on purpose.

A command ends with the exit code of its error. A `UsageError` about the contents of a file that a command
reads has the exit code 1.

::

    SurffollowError
    ├── UsageError (also ValueError)       the caller's argument cannot be right           exit code 2
    │   ├── ConfigError                    a configuration key, value or unit is wrong
    │   ├── PoseError                      a pose is not finite, not 7 long, not unit
    │   ├── ReadingError                   a pushed range, its time or its channel cannot be
    │   ├── RegionError                    a map region is empty, inverted or too large
    │   ├── ClosedError                    the attachment was closed by its owner
    │   ├── InvalidNameError                     a block name is not allowed
    │   ├── ScanInputError                 an image, path or limit that no scan can be planned with
    │   └── SchemaError                    a schema declaration makes no layout
    └── FaultError                         the world is not as it must be                  exit code 1
        ├── ServiceError
        │   ├── NotRunningError            no live service of that name
        │   ├── AlreadyRunningError        a live service owns that name
        │   ├── RefusedError               the service refused a request
        │   └── RequestTimeoutError        the service did not answer in time (also TimeoutError)
        ├── BlockError
        │   ├── LayoutMismatchError        the block was laid out by another version
        │   ├── NotReadyError              the block is being made, replaced or mended; try again
        │   ├── ExistsError                a block of that name is there already
        │   ├── NoSpaceError               /dev/shm cannot hold the block
        │   ├── NoPermissionError          the block's mode forbids it (also PermissionError)
        │   ├── BusyError                  another live process holds what must be held by one
        │   └── BlockTimeoutError          a block's turn did not come in time (also TimeoutError)
        ├── InputFileError                 a file to be read is not there, unreadable or no file
        ├── RecordingError                 a recording or log cannot be read
        ├── MapFileError                   a map file cannot be read or written
        │   └── MapCancelledError          the caller cancelled reading or writing it
        ├── ScanFileError                  a depth image, camera or path file cannot be read or written
        └── DriverError                    a sensor driver cannot start or go on
"""

from __future__ import annotations


class SurffollowError(Exception):
    """Base of all; `exit_code` is what the command line ends with.

    Examples
    --------
    >>> from surffollow.errors import SurffollowError
    >>> from surffollow.units import parse_quantity
    >>> try:
    ...     parse_quantity("5 kg", "m")
    ... except SurffollowError as e:  # and every FaultError
    ...     print(type(e).__name__, e.exit_code, isinstance(e, ValueError))
    UsageError 2 True
    """

    exit_code = 1


class UsageError(SurffollowError, ValueError):
    """The caller's argument is wrong in every situation.

    Examples
    --------
    >>> from surffollow.units import parse_quantity
    >>> parse_quantity("7 ms", "m")
    Traceback (most recent call last):
        ...
    surffollow.errors.UsageError: unit 'ms' is a time, but a length in 'm' (or its multiples) is needed
    """

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file has an unknown key, a value out of range or a wrong unit.

    Examples
    --------
    >>> import surffollow
    >>> from surffollow.errors import ConfigError
    >>> try:
    ...     surffollow.Follower({"ofset_m": 0.1})
    ... except ConfigError:
    ...     print("unknown parameter")
    unknown parameter
    """


class PoseError(UsageError):
    """A pose that is not finite, not seven numbers, or not a unit quaternion."""


class ReadingError(UsageError):
    """A pushed range whose channel, time or distance cannot be."""


class RegionError(UsageError):
    """A map region whose sides are not positive, finite and at most 1e6 m.

    Examples
    --------
    >>> from surffollow.map import HeightMap
    >>> HeightMap.over((0.0, 0.0, -1.0, 1.0))
    Traceback (most recent call last):
        ...
    surffollow.errors.RegionError: the region's sides must be positive, finite and at most 1e6 m
    """


class ClosedError(UsageError):
    """An attachment that its owner closed cannot be used any more."""


class InvalidNameError(UsageError):
    """A service or block name with characters that a path could misread."""


class ScanInputError(UsageError):
    """An image, camera, region, path or limit with which no scan can be planned."""


class SchemaError(UsageError):
    """A block schema that cannot be laid out."""


class FaultError(SurffollowError):
    """The call was right, the world was not.

    Examples
    --------
    >>> from surffollow.errors import FaultError
    >>> from surffollow.map import HeightMap
    >>> try:
    ...     HeightMap.load("no-such-map.txt")
    ... except FaultError as e:
    ...     print(type(e).__name__, e.exit_code)
    MapFileError 1
    """


class ServiceError(FaultError):
    """Something about the service process."""


class NotRunningError(ServiceError):
    """No live service answers under that name.

    Examples
    --------
    >>> from surffollow.client import attach
    >>> from surffollow.errors import NotRunningError
    >>> try:
    ...     robot = attach("no-such-service")
    ... except NotRunningError:
    ...     print("start it: surffollow start")
    start it: surffollow start
    """


class AlreadyRunningError(ServiceError):
    """A live service owns that name already."""


class RefusedError(ServiceError):
    """The service looked at the request and refused it; `code` says why.

    Examples
    --------
    >>> from surffollow.errors import RefusedError, ServiceError
    >>> refused = RefusedError("refused: another client sends the pose", code=3)
    >>> refused.code, isinstance(refused, ServiceError)
    (3, True)
    """

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


class RequestTimeoutError(ServiceError, TimeoutError):
    """The service did not acknowledge within the caller's time."""


class BlockError(FaultError):
    """Something about a shared-memory object."""


class LayoutMismatchError(BlockError):
    """The object's layout hash is not the one this program was built with."""


class NotReadyError(BlockError):
    """The object is being made, replaced or mended: the same call may succeed a moment later."""


class ExistsError(BlockError):
    """A shared-memory object of that name is there already."""


class NoSpaceError(BlockError):
    """The shared-memory file system cannot back the whole object."""


class NoPermissionError(BlockError, PermissionError):
    """The object's mode or owner forbids the access."""


class BusyError(BlockError):
    """Another live process holds what only one may hold."""


class BlockTimeoutError(BlockError, TimeoutError):
    """Readers or the writer of a block did not let the caller in within its time."""


class InputFileError(FaultError):
    """A file to be read that is not there, may not be read, or is a folder, a pipe or a device.

    Examples
    --------
    >>> import surffollow
    >>> from surffollow.errors import InputFileError
    >>> try:
    ...     surffollow.Follower("no-such-file.toml")
    ... except InputFileError as e:
    ...     print(e, e.exit_code)
    cannot read configuration no-such-file.toml: No such file or directory 1
    """


class RecordingError(FaultError):
    """A recording or log file that is damaged, cut short or of another version."""


class MapFileError(FaultError):
    """A map file that cannot be read, written or parsed."""


class MapCancelledError(MapFileError):
    """The caller's progress callback asked to stop; nothing was changed."""


class ScanFileError(FaultError):
    """A depth image, camera table, point cloud or path file that cannot be read or written."""


class DriverError(FaultError):
    """A sensor driver that cannot start or go on."""


def escaped(text: str) -> str:
    r"""Text for a message in which no character controls a terminal, as in names of files and columns.

    Parameters
    ----------
    text : str

    Returns
    -------
    str
        the text, in it an escape sequence for each character that is not printable

    Examples
    --------
    >>> from surffollow.errors import escaped
    >>> print(escaped("a name\x1b[2J"))
    a name\x1b[2J
    """
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)
