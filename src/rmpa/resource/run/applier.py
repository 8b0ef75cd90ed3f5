"""Calls the functions of profiles and contexts, and applies profiles, each between two runs of the tasks."""

from __future__ import annotations

import asyncio
import inspect
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.resource.run.runtime import CALLER
from rmpa.runtime.process import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.resource.declare.behaviour import Hook
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks

_log = logging.getLogger(__name__)
_WAIT: Final = 0.25
"""The longest time in seconds that one call of ``wait`` takes."""


@dataclass(eq=False)
class HungError(RmpaError):
    """A function of a profile or context has not returned within its time-out; the resource ends.

    Args:
        what: ``profile`` or ``context``.
        name: Name of the profile or context.
        limit: The time-out in seconds.
        remedy: What to do about it.
    """

    what: str
    name: str
    limit: float
    remedy: str

    def __str__(self) -> str:
        """Say which function, which time-out, and what to do."""
        text = f"the function of {self.what} {self.name} has not returned within {self.limit:g} s; the resource ends"
        return f"{text}; {self.remedy}"


async def call_function(function: Hook, what: str, name: str, limit: float, remedy: str) -> None:
    """Call a function of a profile or context: a coroutine function in the event loop, a plain one in a thread.

    A thread cannot be stopped from outside, so a plain function that exceeds its time-out goes on until the process
    ends.

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
        outcome = function() if inspect.iscoroutinefunction(function) else await in_thread(function, f"{what} {name}")
        if outcome is not None:
            await outcome

    call = asyncio.create_task(run(), name=f"{what} {name}")
    try:
        await asyncio.wait([call], timeout=limit)
    finally:
        call.cancel()
    if not call.done():
        raise HungError(what, name, limit, remedy)
    if call.cancelled():
        raise RuntimeError("CancelledError: something that it awaited was cancelled")
    call.result()


class Applier:
    """Applies the profiles of one resource; all callbacks are called in the event loop.

    Args:
        runtime: Queues messages while a profile is applied.
        tasks: Paused while a profile is applied.
        timeout: The time-out of a profile's function, in seconds.
        on_applied: ``(profile, error)``: the profile's function has ended; ``error`` is empty if it succeeded.
        on_hung: The profile's function has exceeded its time-out; tasks stay paused.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        timeout: float,
        *,
        on_applied: Callable[[str, str], None],
        on_hung: Callable[[HungError], None],
    ) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._timeout = timeout
        self._on_applied = on_applied
        self._on_hung = on_hung
        self._task: asyncio.Task[None] | None = None

    def begin(self, profile: str) -> None:
        """Begin to apply a profile; the previous one must be complete."""
        self._task = asyncio.get_running_loop().create_task(self._apply(profile), name=f"apply {profile}")

    async def wait(self) -> None:
        """Wait until the profile has been applied, at most 0.25 s."""
        if self._task is not None:
            await asyncio.wait([self._task], timeout=_WAIT)

    async def close(self) -> None:
        """Give up the profile that is being applied, if any; a function in a thread is left behind."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _apply(self, profile: str) -> None:
        why = ""
        try:
            await self._tasks.pause()
            self._runtime.hold()
            remedy = "mend it, or allow it longer: adaptation(apply_timeout=…)"
            function = self._runtime.resource.profiles[profile].apply
            await call_function(function, "profile", profile, self._timeout, remedy)
        except HungError as error:
            self._runtime.release(drop=True)
            self._on_hung(error)
            return
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = f"{type(error).__name__}: {error}"
            _log.warning("! %s: profile %s: %s", self._runtime.node.name, profile, why)
        self._runtime.release(drop=bool(why))
        self._tasks.resume()
        self._on_applied(profile, why)
