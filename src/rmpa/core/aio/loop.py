"""The event loop of an agent: asyncio's, with a short way for the sockets of the data path.

asyncio takes an event from the selector, finds its handle, queues it, looks at its timers, and runs the handle in
its context. For a message that is to be handed on at once this is a fifth of what the interpreter does. Here the
selector itself calls the readers of the data path as soon as ``epoll`` names them, and reports everything else to
asyncio as usual. Nothing else changes: the call is in the loop's thread, between two rounds of callbacks.
"""

from __future__ import annotations

import asyncio
import logging
import math
import select
import selectors
from typing import TYPE_CHECKING, Final, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

    from _typeshed import FileDescriptorLike

_log = logging.getLogger(__name__)

_EPOLL_RESOLUTION: Final = 1e-3
_READ: Final = ~select.EPOLLOUT
_WRITE: Final = ~select.EPOLLIN


class DirectSelector(selectors.BaseSelector):
    """An epoll selector that calls some readers itself."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._keys: dict[int, selectors.SelectorKey] = {}
        self._direct: dict[int, Callable[[], None]] = {}

    def call_directly(self, fd: int, callback: Callable[[], None] | None) -> None:
        """Call ``callback`` when ``fd``, which is registered for reading, is readable; ``None``: as usual again."""
        if callback is None:
            self._direct.pop(fd, None)
        else:
            self._direct[fd] = callback

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
        self._direct.pop(key.fd, None)
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
        key = self._keys[key.fd] = selectors.SelectorKey(fileobj, key.fd, events, data)
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait; call the direct readers that are ready, and return the rest."""
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
        ready = []
        for fd, event in happened:
            direct = self._direct.get(fd)
            if direct is not None and event & _READ:
                direct()
                event &= select.EPOLLOUT  # noqa: PLW2901 - what is left for asyncio
                if not event:
                    continue
            key = self._keys.get(fd)
            if key is not None:
                events = (selectors.EVENT_WRITE if event & _WRITE else 0) | (
                    selectors.EVENT_READ if event & _READ else 0
                )
                ready.append((key, events & key.events))
        return ready

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
        self._keys.clear()
        self._direct.clear()


class AgentLoop(asyncio.SelectorEventLoop):
    """asyncio's selector loop with ``add_direct_reader``."""

    def __init__(self) -> None:
        self._direct_selector = DirectSelector()
        super().__init__(self._direct_selector)

    def add_direct_reader(self, fd: int, callback: Callable[[], None]) -> None:
        """Like ``add_reader``, on the short way; ``remove_reader`` ends it.

        ``callback`` must be quick. What it raises goes to the loop's exception handler.
        """

        def call() -> None:
            try:
                callback()
            except Exception as error:  # noqa: BLE001 - the top of the call: the loop must go on
                self.call_exception_handler({"message": f"reader of FD {fd} failed", "exception": error})

        self.add_reader(fd, callback)
        self._direct_selector.call_directly(fd, call)


def _fd(fileobj: FileDescriptorLike) -> int:
    fd: int = fileobj if isinstance(fileobj, int) else int(fileobj.fileno())
    if fd < 0:
        raise ValueError(f"{fileobj!r} is closed")
    return fd


def _epoll_events(events: int) -> int:
    return (select.EPOLLIN if events & selectors.EVENT_READ else 0) | (
        select.EPOLLOUT if events & selectors.EVENT_WRITE else 0
    )
