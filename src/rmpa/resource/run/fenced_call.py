"""Calls user functions that may hang, each inside a fence that is closed when the call is given up."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import threading
from typing import TYPE_CHECKING

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.declare.fence import inside
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.resource.declare.behaviour import Hook


class FencedCall:
    """One call of a function that applies a profile or enters a context; implements ``Fence``.

    Args:
        kind: ``profile`` or ``context``.
        name: Name of the profile or context.
        on_late_action: ``(name, text)``: called in any thread, once for each kind of action that the function
            attempts after the call was given up.
    """

    def __init__(self, kind: str, name: str, on_late_action: Callable[[str, str], None]) -> None:
        self.kind = kind
        self.name = name
        self.began = 0.0
        """When the function was called, in seconds of the event loop's clock; 0: not yet."""
        self.in_thread = False
        """Whether the function runs in a thread now; a thread cannot be stopped from outside."""
        self._reported: set[str] = set()
        self._on_late_action = on_late_action
        self._closed = False
        # ``give_up`` waits for the action under way, such as one parameter set or one message passed on.
        self._lock = threading.RLock()

    @property
    def closed(self) -> bool:
        """Whether the call was given up."""
        return self._closed

    def give_up(self) -> None:
        """Close the fence: later actions of the function have no effect."""
        with self._lock:
            self._closed = True

    @contextlib.contextmanager
    def action(self, what: str) -> Iterator[None]:
        """Perform an action unless the call was given up; see ``rmpa.resource.declare.fence.Fence``."""
        with self._lock:
            if not self._closed:
                yield
                return
        self.report_blocked(what)
        raise LocalProtocolError(f"{what}: {self.kind} {self.name} was given up meanwhile; it has no effect any more")

    def report_blocked(self, what: str) -> None:
        """Report an action that was attempted after the call was given up; each kind of action once."""
        if what not in self._reported:
            self._reported.add(what)
            text = f"the function of {self.kind} {self.name} was given up; it has no effect: {what}"
            self._on_late_action(self.name, text)

    async def run(self, function: Hook) -> None:
        """Call the function: a coroutine function in the event loop, a plain one in a thread of its own.

        Raises:
            Exception: As raised by the function.
        """
        self.began = asyncio.get_running_loop().time()
        with inside(self):
            if inspect.iscoroutinefunction(function):
                await function()
                return
            self.in_thread = True
            try:
                outcome = await in_thread(function, f"{self.kind} {self.name}")
            finally:
                self.in_thread = False
            if outcome is not None:
                await outcome
