"""Calls of the user's functions: of profiles, contexts and changes of the life cycle, and the preconditions.

A plain function runs in a thread, so it may block; a thread cannot be stopped from outside, so one that exceeds its
time-out goes on until the process ends.
"""

from __future__ import annotations

import asyncio
import inspect
from contextvars import ContextVar
from typing import TYPE_CHECKING

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.runtime.accept import in_thread
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.decision import Profile
    from rmpa.resource.declare import Hook

# ``profile`` or ``context`` in such a function and in the coroutines, tasks and ``asyncio.to_thread`` calls that it
# begins; else empty.
CALLER: ContextVar[str] = ContextVar("caller", default="")


class HungError(RmpaError):
    """A function of a profile or context has not returned within its time-out; the resource ends."""

    code = "resource-trouble"


async def call_hook(function: Hook, name: str) -> None:
    """Call a function, and wait for it: a coroutine function in the event loop, a plain one in a thread of this name.

    Raises:
        Exception: As raised by the function.
    """
    outcome = function() if inspect.iscoroutinefunction(function) else await in_thread(function, name)
    if outcome is not None:
        await outcome


async def call_function(function: Hook, what: str, name: str, limit: float, remedy: str) -> None:
    """Call a function of a profile or context.

    Args:
        function: The function.
        what: ``profile`` or ``context``.
        name: Name of the profile or context.
        limit: The time-out in seconds.
        remedy: What to do if the function exceeds it.

    Raises:
        HungError: The function has exceeded its time-out.
        Exception: As raised by the function.
    """

    async def run() -> None:
        CALLER.set(what)
        await call_hook(function, f"{what} {name}")

    call = start_task(run(), f"{what} {name}", raises=(Exception,))
    try:
        await asyncio.wait([call], timeout=limit)
    finally:
        call.cancel()
    if not call.done():
        text = f"the function of {what} {name} has not returned within {limit:g} s; the resource ends"
        raise HungError(f"{text}; {remedy}")
    if call.cancelled():
        raise RuntimeError("CancelledError: something that it awaited was cancelled")
    call.result()


class Preconditions:
    """The preconditions of one resource's profiles (``needs=``), each in a thread of its own: they may block.

    Args:
        profiles: The declared profiles, by name.
    """

    def __init__(self, profiles: Mapping[str, Profile]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        # The call under way, by profile.
        self._calls: dict[str, asyncio.Task[str | bool | None]] = {}

    async def check(self) -> dict[str, str]:
        """Call all preconditions, except those whose last call has not returned; at most one check at a time.

        Returns:
            The profiles that must not run, with the reason, after ``limits.PRECONDITION_TIMEOUT`` seconds at most.
        """
        for name, needs in self._needs.items():
            if name not in self._calls:
                what = f"needs of {name}"
                self._calls[name] = start_task(in_thread(needs, what), what, raises=(Exception,))
        if not self._calls:
            return {}
        done, _ = await asyncio.wait(self._calls.values(), timeout=limits.PRECONDITION_TIMEOUT)
        found = {}
        for name, call in list(self._calls.items()):
            why: str | bool | None = f"its precondition has not answered for {limits.PRECONDITION_TIMEOUT:g} s"
            if call in done:
                del self._calls[name]
                error = call.exception()
                why = f"its precondition failed: {type(error).__name__}: {error}" if error else call.result()
            if why is False:
                why = "its precondition does not hold"
            if why and isinstance(why, str):
                found[name] = why
        return found

    async def close(self) -> None:
        """Stop waiting for calls; threads that hang are left behind."""
        await end_tasks(*self._calls.values())
