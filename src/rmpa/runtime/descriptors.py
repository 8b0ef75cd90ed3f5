"""The file descriptors of this process: who may take the last ones, and what is told when they run out.

A process without a free descriptor can neither accept nor dial. What carries data stops early, so that the ROS core,
the control socket and the links to peers still work: a user has to be able to ask what is wrong.

No count is kept. The kernel gives each new descriptor the lowest free number (POSIX, open(2)): a number near the
limit says that all below it are taken.
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
"""The errors of accept(2) and socket(2) that say: not now, for want of descriptors or memory."""


class Use(enum.Enum):
    """What a descriptor is for; the value says how many reserves it has to leave free."""

    PROXY = 2.0
    """The listening sockets of what stands for a remote node: they leave room for those who connect to them."""
    DATA = 1.0
    """Connections of topics and services, and to the slave APIs of nodes: nothing of the reserve is for them."""
    CORE = 0.5
    """The ROS core's XML-RPC."""
    LINK = 0.0
    """Links to peers and the control socket: they may take the last one."""


@dataclass(slots=True)
class DescriptorShortage:
    """A time without descriptors.

    Attributes:
        last: When something was refused last, by the loop's clock.
        began: When it began.
        least: Of what was refused, the use with the least right; when it has room again the shortage is over.
        most: The one with the greatest right.
        problem: What happened and what to do, ready to read.
        told: Whether the log says so.
    """

    last: float
    began: float
    least: Use
    most: Use
    problem: str
    told: bool = False


class Descriptors:
    """The descriptors of one process, shared by all that accepts and dials.

    Not thread-safe: for the loop's thread.

    Attributes:
        counters: ``descriptors.refused.data`` (and ``.proxy``, ``.core``, ``.link``): attempts to accept or to dial
            that found none, repetitions among them; ``descriptors.idle_closed``; ``descriptors.shortages``.
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
        """How many this process may have: the soft limit, which may be changed while it runs (prlimit(1))."""
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return sys.maxsize if soft == resource.RLIM_INFINITY else soft

    @property
    def hard_limit(self) -> int:
        """What the soft limit may be raised to without further rights."""
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        return sys.maxsize if hard == resource.RLIM_INFINITY else hard

    @property
    def reserve(self) -> int:
        """How many of them are kept for the core and the links."""
        return _reserve(self.limit)

    @property
    def open(self) -> int:
        """How many are open, counted a moment ago."""
        now = time.monotonic()
        if now >= self._count_until:
            self._count = _count_open(self.limit)
            # Older kernels list them, which takes 20 ms for 60,000.
            self._count_until = now + max(1.0, (time.monotonic() - now) * limits.DESCRIPTORS_COUNT_SHARE)
        return self._count

    @property
    def shortage(self) -> DescriptorShortage | None:
        """The one that is not over yet; none is left when the loop ends that looked after it."""
        if self._loop is not None and self._loop.is_closed():
            self._loop = self._shortage = None
        return self._shortage

    @property
    def short(self) -> bool:
        """Whether something was refused, and the shortage is not over yet."""
        return self.shortage is not None

    def has_room(self, use: Use, fd: int) -> bool:
        """Whether ``use`` may keep a descriptor whose number, the lowest that was free, is ``fd``."""
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
        """A new socket, non-blocking, if there is a descriptor left for ``use``.

        Raises:
            OSError: There is none (``EMFILE``), or the system says no; the refusal is counted and told.
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
            what: Who wanted it, for the log: ``node /talker``.
            error: What the system said; none where the reserve was spared.
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
        if self._loop is not loop:  # the first refusal, or the loop of the one before has ended
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
        """End the shortage when nothing was refused for a while and there is room; look again otherwise."""
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

    # --- giving up what is idle -------------------------------------------------------------------------------

    def offer(self, owner: object, close_one: Callable[[], bool] | None) -> None:
        """Let ``close_one`` be called when descriptors run out: it closes an idle connection, if ``owner`` has one.

        Args:
            owner: Who offers; a later offer of the same one takes the place of the first.
            close_one: Returns whether it closed one; ``None`` withdraws the offer.
        """
        if close_one is None:
            self._idle.pop(owner, None)
        else:
            self._idle[owner] = close_one

    def make_room(self) -> bool:
        """Close one connection that is idle, and return whether there was one.

        Its descriptor is free in the loop's next round.
        """
        for close_one in self._idle.values():
            if close_one():
                self.counters.add("descriptors.idle_closed")
                return True
        return False


def is_shortage(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, says that no descriptor was left."""
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
        return sum(1 for _ in os.scandir("/proc/self/fd")) - 1  # less the one that lists them
    except OSError:
        return limit  # none is left to list them


def _reserve(soft: int) -> int:
    return min(limits.DESCRIPTORS_RESERVED, soft // limits.DESCRIPTORS_RESERVED_PART)


def raise_file_limit() -> int:
    """Raise the soft limit of open files to the hard one, or ``limits.OPEN_FILES``; return how many that are."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = limits.OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, limits.OPEN_FILES)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    with contextlib.suppress(OSError, ValueError):  # some sandboxes forbid it; then the agent runs with what it has
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return soft


DESCRIPTORS: Final = Descriptors()
"""Those of this process."""
