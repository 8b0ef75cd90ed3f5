"""The event loop of an agent: asyncio's, with a short way for the sockets of the data path.

asyncio takes an event from the selector, finds its handle, queues it, looks at its timers, and runs the handle in
its context. For a message that is to be handed on at once this is a fifth of what the interpreter does. Here the
selector itself calls the readers (and writers) of the data path as soon as ``epoll`` names them, and reports
everything else to asyncio as usual.

Data also goes before control work that has begun: the loop looks at the data path's sockets before each ordinary
callback, and work that takes long calls ``yield_to_data()`` between its slices. A look costs a quarter of a
microsecond.
What such a reader calls may therefore run in the middle of whatever breathes: at a breath nothing may be half done.
docs/design/isolation.md says what was measured.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import logging
import math
import select
import selectors
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from _typeshed import FileDescriptorLike

_log = logging.getLogger(__name__)

_EPOLL_RESOLUTION: Final = 1e-3
_LOOK: Final = 64
_BREATHS: Final = 8
"""Breaths for one chore: a look at a counter is cheap, and yet not for each callback."""
_ITEMS: Final = 64
"""Steps of some work between two breaths, of a microsecond or less each."""
_RUN: Final = 256
"""Items that are sorted at once, some 50 microseconds."""
_T = TypeVar("_T")
_Ts = TypeVarTuple("_Ts")
_READ: Final = ~select.EPOLLOUT
_WRITE: Final = ~select.EPOLLIN


class DirectSelector(selectors.BaseSelector):
    """An epoll selector that calls some readers and writers itself: those of the data path."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        # The direct ones once more, so that a look at them alone costs the same however many others there are.
        self._data = select.epoll()
        self._look = self._data.poll
        self._keys: dict[int, selectors.SelectorKey] = {}
        self._readers: dict[int, Callable[[], None]] = {}
        self._writers: dict[int, Callable[[], None]] = {}
        self.calling = False
        """Whether a direct reader or writer is at work."""
        self.woke = self.woke_before = time.monotonic()

    def call_directly(self, fd: int, reader: Callable[[], None] | None) -> None:
        """Call ``reader`` when ``fd``, which is registered for reading, is readable; ``None``: as usual again."""
        if reader is None:
            self._forget(fd)
            return
        if fd not in self._readers:
            self._data.register(fd, _epoll_events(self._keys[fd].events))
        self._readers[fd] = reader

    def write_directly(self, fd: int, writer: Callable[[], None] | None) -> None:
        """Likewise when it is writable, as long as it has a direct reader too."""
        if writer is not None and fd in self._readers:
            self._writers[fd] = writer
        else:
            self._writers.pop(fd, None)

    def poll_data(self) -> None:
        """Call the direct readers and writers that are ready now; does nothing when called by one of them."""
        if not self.calling and (happened := self._look(0, _LOOK)):
            self._call(happened)

    def register(
        self,
        fileobj: FileDescriptorLike,
        events: int,
        data: Any = None,
    ) -> selectors.SelectorKey:
        """Follow a file object.

        Raises:
            KeyError: It is followed already.
        """
        fd = _fd(fileobj)
        if fd in self._keys:
            raise KeyError(f"{fileobj!r} (FD {fd}) is already registered")
        self._epoll.register(fd, _epoll_events(events))
        key = self._keys[fd] = selectors.SelectorKey(fileobj, fd, events, data)
        return key

    def unregister(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """Follow a file object no longer.

        Raises:
            KeyError: It is not followed.
        """
        key = self._keys.pop(_fd(fileobj))
        self._forget(key.fd)
        try:
            self._epoll.unregister(key.fd)
        except OSError:
            _log.debug("FD %d was closed before it was unregistered", key.fd)
        return key

    def modify(
        self,
        fileobj: FileDescriptorLike,
        events: int,
        data: Any = None,
    ) -> selectors.SelectorKey:
        """Follow a file object for other events.

        Raises:
            KeyError: It is not followed.
        """
        key = self._keys[_fd(fileobj)]
        if events != key.events:
            self._epoll.modify(key.fd, _epoll_events(events))
            if not events & selectors.EVENT_READ:
                self._forget(key.fd)
            elif key.fd in self._readers:
                self._data.modify(key.fd, _epoll_events(events))
        key = self._keys[key.fd] = selectors.SelectorKey(fileobj, key.fd, events, data)
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait; call the direct readers and writers that are ready, and return the rest."""
        if timeout is None:
            wait = -1.0
        elif timeout <= 0:
            wait = 0.0
        else:
            # Rounded up, as asyncio's own does: a timer must not find itself early and spin.
            wait = math.ceil(timeout / _EPOLL_RESOLUTION) * _EPOLL_RESOLUTION
        try:
            happened = self._epoll.poll(wait, max(len(self._keys), 1))
        except InterruptedError:
            return []
        self.woke_before, self.woke = self.woke, time.monotonic()
        ready = []
        for fd, event in self._call(happened):
            key = self._keys.get(fd)
            if key is not None:
                events = (selectors.EVENT_WRITE if event & _WRITE else 0) | (
                    selectors.EVENT_READ if event & _READ else 0
                )
                ready.append((key, events & key.events))
        return ready

    def _call(self, happened: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Call those that are direct; return what is left for asyncio."""
        rest = []
        self.calling = True
        try:
            for fd, event in happened:
                if (reader := self._readers.get(fd)) is not None and event & _READ:
                    reader()
                    event &= select.EPOLLOUT  # noqa: PLW2901 - what is left of it
                    if not event:
                        continue
                if (writer := self._writers.get(fd)) is not None and event & select.EPOLLOUT:
                    writer()
                    continue
                rest.append((fd, event))
        finally:
            self.calling = False
        return rest

    def _forget(self, fd: int) -> None:
        self._writers.pop(fd, None)
        if self._readers.pop(fd, None) is not None:
            with contextlib.suppress(OSError):  # closed before
                self._data.unregister(fd)

    def get_map(self) -> Mapping[FileDescriptorLike, selectors.SelectorKey]:
        """What is followed, by file descriptor."""
        return cast("Mapping[FileDescriptorLike, selectors.SelectorKey]", self._keys)

    def get_key(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """The key of a file object.

        Raises:
            KeyError: It is not followed.
        """
        return self._keys[_fd(fileobj)]

    def close(self) -> None:
        """Follow nothing any more."""
        self._epoll.close()
        self._data.close()
        self._keys.clear()
        self._readers.clear()
        self._writers.clear()


class AgentLoop(asyncio.SelectorEventLoop):
    """asyncio's selector loop with ``add_direct_reader``; data goes before every ordinary callback."""

    def __init__(self) -> None:
        self._direct_selector = DirectSelector()
        super().__init__(self._direct_selector)
        self._poll_data = self._direct_selector.poll_data
        self._chore: Callable[[], None] | None = None
        self._breaths = 0
        # asyncio takes each callback of a round from here, and from nowhere else.
        self._ready: deque[asyncio.Handle] = _Turnstile(self.breathe)

    @property
    def looked_before(self) -> float:
        """When the sockets were last looked at before what is being read now came, in monotonic seconds.

        What was not there then came later: so long, and no longer, this process may have let it wait.
        """
        return self._direct_selector.woke_before

    def breathe(self) -> None:
        """Let data that has arrived be handled now; code without a loop at hand calls ``yield_to_data``."""
        self._poll_data()
        if self._chore is not None and not self._direct_selector.calling:
            self._breaths += 1
            if self._breaths >= _BREATHS:
                self._breaths = 0
                self._chore()

    def between(self, chore: Callable[[], None] | None) -> None:
        """Call ``chore`` at every few breaths, or nothing any more; it takes microseconds where it has nothing to do.

        For what control work must not put off until it ends, and data need not wait for.
        """
        self._chore = chore

    def add_direct_reader(self, fd: int, callback: Callable[[], None]) -> None:
        """Like ``add_reader``, on the short way; ``remove_reader`` ends it.

        ``callback`` must be quick. It is called between the slices of any other work: see the module's text. What it
        raises goes to the loop's exception handler. A writer that is added afterwards is called in the same way.
        """
        self.add_reader(fd, callback)
        self._direct_selector.call_directly(fd, self._guarded(fd, "reader", callback))

    def add_writer(self, fd: FileDescriptorLike, callback: Callable[[*_Ts], Any], *args: *_Ts) -> None:
        """As asyncio's; on the short way where ``fd`` has a direct reader."""
        super().add_writer(fd, callback, *args)
        number = _fd(fd)
        self._direct_selector.write_directly(number, self._guarded(number, "writer", lambda: callback(*args)))

    def remove_writer(self, fd: FileDescriptorLike) -> bool:
        """As asyncio's."""
        self._direct_selector.write_directly(_fd(fd), None)
        return super().remove_writer(fd)

    def _guarded(self, fd: int, what: str, callback: Callable[[], None]) -> Callable[[], None]:
        def call() -> None:
            try:
                callback()
            except Exception as error:  # noqa: BLE001 - the top of the call: the loop must go on
                self.call_exception_handler({"message": f"{what} of FD {fd} failed", "exception": error})

        return call


def yield_to_data() -> None:
    """Between two slices of long work in a loop: let data that has come go first.

    Nothing happens on other loops than ``AgentLoop``, nor outside of one.
    """
    loop = asyncio._get_running_loop()  # noqa: SLF001 - the public one raises where there is none
    if isinstance(loop, AgentLoop):
        loop.breathe()


def yielding_to_data(items: Iterable[_T], /, every: int = _ITEMS) -> Iterator[_T]:
    """Pass on items one after the other, and breathe at each one out of ``every`` (``core.yielding.Breathing``)."""
    for number, item in enumerate(items):
        if number % every == 0:
            yield_to_data()
        yield item


def breathing_sorted(items: Iterable[str]) -> Iterator[str]:
    """The same as ``sorted`` would give, without its milliseconds for thousands."""
    rest = iter(items)
    runs = []
    while run := sorted(islice(rest, _RUN)):
        runs.append(run)
        yield_to_data()
    return heapq.merge(*runs)


class _Turnstile(deque[asyncio.Handle]):
    """The callbacks that are ready; data goes before each of them."""

    def __init__(self, breathe: Callable[[], None]) -> None:
        super().__init__()
        self._breathe = breathe

    def popleft(self) -> asyncio.Handle:
        """The next one to run."""
        self._breathe()
        return super().popleft()


def _fd(fileobj: FileDescriptorLike) -> int:
    fd: int = fileobj if isinstance(fileobj, int) else int(fileobj.fileno())
    if fd < 0:
        raise ValueError(f"{fileobj!r} is closed")
    return fd


def _epoll_events(events: int) -> int:
    return (select.EPOLLIN if events & selectors.EVENT_READ else 0) | (
        select.EPOLLOUT if events & selectors.EVENT_WRITE else 0
    )
