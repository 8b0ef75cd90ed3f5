"""The file descriptors of this process: which uses may take the last ones, and how a shortage is reported.

A process without a free descriptor can neither accept nor dial. Connections for data are refused early, so that the
ROS core, the control socket and the links to peers still work: a user must be able to ask what is wrong.

No count is kept. The kernel gives each new descriptor the lowest free number (POSIX, open(2)): a number near the
limit means that all lower ones are taken.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import errno
import logging
import os
import resource
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters
from rmpa.core.errors import OutOfDescriptors
from rmpa.core.open_files import remedy
from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Callable

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


@dataclass(slots=True)
class DescriptorShortage:
    """A period in which descriptors were refused.

    Attributes:
        last: When a descriptor was last refused, in seconds of the loop's clock.
        began: When a descriptor was first refused, on the same clock.
        least: Of the refused uses, the one that must leave the largest reserve; the shortage is over when this use
            has room again.
        most: Of the refused uses, the one that must leave the smallest reserve.
        problem: What happened and what to do, as a text for the user.
        told: Whether the shortage was logged.
    """

    last: float
    began: float
    least: Use
    most: Use
    problem: str
    told: bool = False


class Descriptors:
    """The descriptors of one process, shared by all servers and clients. Not thread-safe: for the loop's thread.

    Attributes:
        counters: ``descriptors.refused.data`` (and ``.proxy``, ``.core``, ``.link``): attempts to accept or to dial
            without a free descriptor, repeated attempts included; ``descriptors.idle_closed``;
            ``descriptors.shortages``.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._shortage: DescriptorShortage | None = None
        self._idle: dict[object, Callable[[], bool]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._told: dict[Use, float] = {}
        self._count, self._count_until = 0, float("-inf")

    # --- how many ---------------------------------------------------------------------------------------------

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

    @property
    def shortage(self) -> DescriptorShortage | None:
        """The present shortage, or ``None``; a shortage ends with the event loop in which it began."""
        if self._loop is not None and self._loop.is_closed():
            self._loop = self._shortage = None
        return self._shortage

    @property
    def short(self) -> bool:
        """Whether there is a shortage."""
        return self.shortage is not None

    def has_room(self, use: Use, fd: int) -> bool:
        """Whether ``use`` may keep the descriptor ``fd``, whose number was the lowest free one."""
        soft = self.limit
        return fd < soft - int(_reserve(soft) * use.value)

    # --- refusing ---------------------------------------------------------------------------------------------

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
        if self.has_room(use, sock.fileno()):
            return sock
        sock.close()
        self.make_room()
        self.refuse(use, what)
        raise OSError(errno.EMFILE, "too many open files; the last ones are kept for the core and the links")

    def refuse(self, use: Use, what: str, error: OSError | None = None) -> None:
        """Count an attempt for which there was no descriptor, and log the first one of a shortage.

        Args:
            use: What the descriptor was for.
            what: What needed it, for the log: ``node /talker``.
            error: The system's error; ``None`` if there was a descriptor, but it belongs to the reserve.
        """
        self.counters.add(f"descriptors.refused.{use.name.lower()}")
        loop = asyncio.get_running_loop()
        now = loop.time()
        short = self.shortage
        if short is None:
            self.counters.add("descriptors.shortages")
            short = self._shortage = DescriptorShortage(now, now, use, use, "")
        short.last = now
        short.least = max(short.least, use, key=_value)
        if not short.problem or use.value < short.most.value:
            short.most, short.problem = use, self._problem(use, what, error)
            self._tell(short, now)
        if self._loop is not loop:  # the first refusal, or the first one in a new loop
            self._loop = loop
            loop.call_later(limits.DESCRIPTORS_QUIET, self._look)

    def _tell(self, short: DescriptorShortage, now: float) -> None:
        if now - self._told.get(short.most, float("-inf")) >= limits.DESCRIPTORS_TELL:
            self._told[short.most] = now
            short.told = True
            _log.warning("! %s", short.problem)

    def _problem(self, use: Use, what: str, error: OSError | None) -> str:
        if error is not None and error.errno != errno.EMFILE:
            return (
                f"{what} has to wait: the system has no room for another file ({error.strerror}); see "
                "/proc/sys/fs/file-nr and `free`"
            )
        kept = {
            Use.PROXY: f", of which the last {2 * self.reserve} are kept for connections, the core and the links",
            Use.DATA: f", of which the last {self.reserve} are kept for the core and the links",
            Use.CORE: ", of which the last ones are kept for the links",
            Use.LINK: "",
        }
        text = f"{what} has to wait: no file descriptors left (the limit is {self.limit}{kept[use]})"
        return f"{text}; {remedy(os.getpid())}"

    def _look(self) -> None:
        """End the shortage if nothing was refused for a while and there is room; else check again later."""
        self._loop = None
        loop = asyncio.get_running_loop()
        short = self.shortage
        if short is None:
            return
        if loop.time() - short.last >= limits.DESCRIPTORS_QUIET and self._has_room_now(short.least):
            self._shortage = None
            if short.told:
                _log.info("= file descriptors are free again after %.0f s", loop.time() - short.began)
            return
        self._loop = loop
        loop.call_later(limits.DESCRIPTORS_QUIET, self._look)

    def _has_room_now(self, use: Use) -> bool:
        try:
            with socket.socket() as probe:
                return self.has_room(use, probe.fileno())
        except OSError:
            return False

    # --- closing idle connections -----------------------------------------------------------------------------

    def offer(self, owner: object, close_one: Callable[[], bool] | None) -> None:
        """Register a function that closes an idle connection of ``owner`` when descriptors run out.

        Args:
            owner: Identifies the offer; a later offer of the same owner replaces it.
            close_one: Closes one idle connection, and returns whether there was one; ``None`` withdraws the offer.
        """
        if close_one is None:
            self._idle.pop(owner, None)
        else:
            self._idle[owner] = close_one

    def make_room(self) -> bool:
        """Close one idle connection, and return whether there was one.

        Its descriptor is free in the loop's next iteration.
        """
        for close_one in self._idle.values():
            if close_one():
                self.counters.add("descriptors.idle_closed")
                return True
        return False


def is_shortage(error: BaseException | None) -> bool:
    """Whether an error, or its cause, is a lack of descriptors."""
    if error is None or isinstance(error, OutOfDescriptors):
        return error is not None
    return (isinstance(error, OSError) and error.errno in OUT_OF_DESCRIPTORS) or is_shortage(error.__cause__)


def _value(use: Use) -> float:
    return use.value


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
