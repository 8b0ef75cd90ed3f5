"""Calls a function of the user's that may hang, within a fence that is closed when it is given up."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import threading
from typing import TYPE_CHECKING

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.declare.fence import within
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.resource.declare.resource import Hook


class Call:
    """One call of a function that applies a profile, or that enters a context.

    Args:
        who: ``profile`` or ``context``.
        name: Which one.
        on_stopped: ``(call, what)``: it wanted to do something after it was given up; called in any thread.
    """

    def __init__(self, who: str, name: str, on_stopped: Callable[[Call, str], None]) -> None:
        self.who = who
        self.name = name
        self.began = 0.0
        """When the function was called, by the loop's clock; 0: not yet."""
        self.in_thread = False
        """Whether it is in a thread now, where nothing can end it from outside."""
        self.said: set[str] = set()
        """What it did without effect."""
        self._on_stopped = on_stopped
        self._closed = False
        # Whoever closes it waits until what is under way has happened: one parameter is set, one message handed on.
        self._lock = threading.RLock()

    @property
    def closed(self) -> bool:
        """Whether it was given up."""
        return self._closed

    def give_up(self) -> None:
        """Nothing that it does from now on has an effect."""
        with self._lock:
            self._closed = True

    @contextlib.contextmanager
    def passage(self, what: str) -> Iterator[None]:
        """See ``rmpa.resource.declare.fence.Fence``."""
        with self._lock:
            if not self._closed:
                yield
                return
        self.stopped(what)
        raise LocalProtocolError(f"{what}: {self.who} {self.name} was given up meanwhile; it has no effect any more")

    def stopped(self, what: str) -> None:
        """Report something that came too late."""
        self._on_stopped(self, what)

    async def run(self, function: Hook) -> None:
        """Call the function: a coroutine function here, a plain one in a thread of its own.

        Raises:
            Exception: What the function raises.
        """
        self.began = asyncio.get_running_loop().time()
        with within(self):
            if inspect.iscoroutinefunction(function):
                await function()
                return
            self.in_thread = True
            try:
                outcome = await in_thread(function, f"{self.who} {self.name}")
            finally:
                self.in_thread = False
            if outcome is not None:
                await outcome
