"""Whether what is done through a resource's API still counts: not if its function was given up meanwhile.

A function of the user's that hangs cannot be ended from outside. What it does later, when another profile runs, must
not land on top of that one. So each call of such a function has a fence around it; when it is given up the fence is
closed. All that a resource offers to act with (publishing, parameters, observations, what is asked of others) asks
here whether the way is open. Threads that the function starts by itself are not within its fence; its coroutines and
``asyncio.to_thread`` are.
"""

from __future__ import annotations

import contextlib
from contextvars import ContextVar
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator


class Fence(Protocol):
    """Around one call of a function of the user's."""

    who: str
    """What the function brings about: ``profile`` or ``context``."""

    @property
    def closed(self) -> bool:
        """Whether the function was given up."""
        ...

    def passage(self, what: str) -> contextlib.AbstractContextManager[None]:
        """Act within; the fence is not closed meanwhile.

        Args:
            what: What is done, as in "publish on ranges".

        Raises:
            LocalProtocolError: The function was given up; what it wanted to do is reported.
        """
        ...

    def stopped(self, what: str) -> None:
        """Report something that came too late."""
        ...


_AROUND: ContextVar[Fence | None] = ContextVar("fence", default=None)


def around() -> Fence | None:
    """The fence around who calls; ``None`` around what is never given up."""
    return _AROUND.get()


def passage(what: str) -> contextlib.AbstractContextManager[None]:
    """Act, unless the function that does so was given up; see ``Fence.passage``."""
    fence = _AROUND.get()
    return contextlib.nullcontext() if fence is None else fence.passage(what)


@contextlib.contextmanager
def within(fence: Fence) -> Iterator[None]:
    """Put a fence around what is called, here and in the threads and tasks that are begun from here."""
    token = _AROUND.set(fence)
    try:
        yield
    finally:
        _AROUND.reset(token)
