"""Fencing: actions of a user's function have no effect after the function was given up.

A function that hangs in a thread cannot be stopped from outside. Its later actions, under another profile, must not
take effect. Each call of such a function is surrounded by a fence, which is closed when the call is given up. All
actions that a resource offers (publishing, parameters, observations, requirements on other resources) check the fence
first. Coroutines, tasks and ``asyncio.to_thread`` calls of the function are inside its fence; threads that it starts
by other means are not.
"""

from __future__ import annotations

import contextlib
from contextvars import ContextVar
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator


class Fence(Protocol):
    """Surrounds one call of a user's function."""

    kind: str
    """What the function applies: ``profile`` or ``context``."""

    @property
    def closed(self) -> bool:
        """Whether the call was given up."""
        ...

    def action(self, what: str) -> contextlib.AbstractContextManager[None]:
        """Enclose an action; the fence cannot be closed while it is performed.

        Args:
            what: The action, as in "publish on ranges".

        Raises:
            LocalProtocolError: The call was given up; the action is reported and not performed.
        """
        ...

    def report_blocked(self, what: str) -> None:
        """Report an action that was attempted after the call was given up."""
        ...


_CURRENT: ContextVar[Fence | None] = ContextVar("fence", default=None)


def current_fence() -> Fence | None:
    """The fence around the calling code; ``None`` for code that is never given up."""
    return _CURRENT.get()


def fenced_action(what: str) -> contextlib.AbstractContextManager[None]:
    """Enclose an action, which is refused if the calling function was given up; see ``Fence.action``."""
    fence = _CURRENT.get()
    return contextlib.nullcontext() if fence is None else fence.action(what)


@contextlib.contextmanager
def inside(fence: Fence) -> Iterator[None]:
    """Surround the calls in this block with a fence, and also tasks and ``asyncio.to_thread`` calls started in it."""
    token = _CURRENT.set(fence)
    try:
        yield
    finally:
        _CURRENT.reset(token)
