"""The file descriptors of this process: which uses may take the last ones, and what is said when they run out.

A process without a free descriptor can neither accept nor dial. Connections for data are refused early, so that the
ROS core, the control socket and the links to peers still work: a user must be able to ask what is wrong.

No count is kept. The kernel gives each new descriptor the lowest free number (POSIX, open(2)): a number near the
limit means that all lower ones are taken.
"""

from __future__ import annotations

import contextlib
import enum
import errno
import logging
import os
import resource
import socket
import sys
import time
from pathlib import Path
from typing import Final

from rmpa.core.counters import Counters, RefusalLog, remedy
from rmpa.core.errors import OutOfDescriptors
from rmpa.runtime import limits

_log = logging.getLogger(__name__)

OUT_OF_DESCRIPTORS: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
"""Errors of accept(2) and socket(2) about a lack of descriptors or memory, which may pass."""


class Use(enum.Enum):
    """The purpose of a descriptor; the value is the number of reserves that it must leave free."""

    PROXY = 2.0
    """Listening sockets of the proxies of remote nodes; they must leave room for the connections to those sockets."""
    DATA = 1.0
    """Connections of topics and services, and to the slave APIs of nodes: they must leave the whole reserve."""
    CORE = 0.5
    """The ROS core's XML-RPC."""
    LINK = 0.0
    """Links to peers and the control socket: they may take the last descriptor."""


class Descriptors:
    """The descriptors of one process, shared by all servers and clients. Not thread-safe: for the loop's thread.

    Attributes:
        counters: ``descriptors.refused.data`` (``.proxy``, ``.core``, ``.link``): attempts to accept or to dial
            without a free descriptor, repeated attempts included.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._problem, self._refused_at = "", float("-inf")
        self._count, self._count_until = 0, float("-inf")

    @property
    def limit(self) -> int:
        """The soft limit, which may be changed while the process runs (prlimit(1))."""
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return sys.maxsize if soft == resource.RLIM_INFINITY else soft

    @property
    def hard_limit(self) -> int:
        """The highest soft limit that needs no privileges."""
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        return sys.maxsize if hard == resource.RLIM_INFINITY else hard

    @property
    def reserve(self) -> int:
        """The number of descriptors that are kept for the core and the links."""
        return _reserve(self.limit)

    @property
    def open(self) -> int:
        """The number of open descriptors, as of the last second or so."""
        now = time.monotonic()
        if now >= self._count_until:
            self._count = _count_open(self.limit)
            # On older kernels the descriptors must be listed, which takes 20 ms for 60,000 of them.
            self._count_until = now + max(1.0, (time.monotonic() - now) * limits.DESCRIPTORS_COUNT_SHARE)
        return self._count

    def has_room(self, use: Use, fd: int) -> bool:
        """Whether ``use`` may keep the descriptor ``fd``, whose number was the lowest free one."""
        soft = self.limit
        return fd < soft - int(_reserve(soft) * use.value)

    @property
    def problem(self) -> str:
        """What was refused in the last seconds and what to do, as a text for the user; empty for nothing."""
        return self._problem if time.monotonic() - self._refused_at < limits.DESCRIPTORS_TOLD else ""

    def open_socket(
        self,
        use: Use,
        family: int = socket.AF_INET,
        kind: int = socket.SOCK_STREAM,
        what: str = "a new connection",
    ) -> socket.socket:
        """A new non-blocking socket, if there is a descriptor left for ``use``.

        Raises:
            OSError: There is no descriptor left (``EMFILE``; counted and logged), or another error.
        """
        try:
            sock = socket.socket(family, kind | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        except OSError as error:
            if error.errno in OUT_OF_DESCRIPTORS:
                self.refuse(use, what, error)
            raise
        if not self.keeps(use, sock, what):
            raise OSError(errno.EMFILE, "too many open files; the last ones are kept for the core and the links")
        return sock

    def keeps(self, use: Use, sock: socket.socket, what: str) -> bool:
        """Whether there is a descriptor left for this new socket; else it is closed, counted and logged."""
        if self.has_room(use, sock.fileno()):
            return True
        sock.close()
        self.refuse(use, what)
        return False

    def refuse(self, use: Use, what: str, error: OSError | None = None) -> None:
        """Count an attempt for which there was no descriptor; log one of each use in a while.

        Args:
            use: What the descriptor was for.
            what: What needed it, for the log: ``node /talker``.
            error: The system's error; ``None`` if there was a descriptor, but it belongs to the reserve.
        """
        if error is not None and error.errno != errno.EMFILE:
            why = f"the system has no room for another file ({error.strerror}); see /proc/sys/fs/file-nr and `free`"
        else:
            kept = f"the limit is {self.limit}, of which the last {self.reserve} are kept for the core and the links"
            why = f"no file descriptors left ({kept}); {remedy(os.getpid())}"
        self._problem, self._refused_at = f"{what} is refused: {why}", time.monotonic()
        self._refusals.refuse(self._refused_at, f"descriptors.refused.{use.name.lower()}", "", self._problem)


def is_shortage(error: BaseException | None) -> bool:
    """Whether an error, or its cause, is a lack of descriptors."""
    if error is None or isinstance(error, OutOfDescriptors):
        return error is not None
    return (isinstance(error, OSError) and error.errno in OUT_OF_DESCRIPTORS) or is_shortage(error.__cause__)


def _count_open(limit: int) -> int:
    with contextlib.suppress(OSError):
        # The directory's size, since Linux 6.2; 0 before.
        if count := Path("/proc/self/fd").stat().st_size:
            return count
    try:
        return sum(1 for _ in os.scandir("/proc/self/fd")) - 1  # without the descriptor of this listing
    except OSError:
        return limit  # no descriptor is left for the listing: all are open


def _reserve(soft: int) -> int:
    return min(limits.DESCRIPTORS_RESERVED, soft // limits.DESCRIPTORS_RESERVED_PART)


def raise_file_limit() -> int:
    """Raise the soft limit of open files to the hard one, or ``limits.OPEN_FILES``; return the new limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = limits.OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, limits.OPEN_FILES)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    with contextlib.suppress(OSError, ValueError):  # some sandboxes forbid it; then the old limit stays
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return soft


DESCRIPTORS: Final = Descriptors()
"""The descriptors of this process."""
