"""Applies profiles, each between two runs of the tasks, and isolates functions that hang.

A plain function that hangs in a thread cannot be stopped. It is given up: its later actions through the resource have
no effect (``resource.declare.fence``). When it ends, the profile that runs is applied once more, because the function
may have changed the device itself. Until then its own profile is excluded: calls of one function must not overlap.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from typing import TYPE_CHECKING, Final

from rmpa.resource.run.fenced_call import FencedCall

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks

_log = logging.getLogger(__name__)
_WAIT: Final = 0.25
"""The longest time in seconds that one call of ``wait`` takes."""
_WAIT_IDLE: Final = 0.02
"""Seconds that ``wait`` takes if the task that applied the profile has died; the time-out gives the profile up."""


class Applier:
    """Applies the profiles of one resource; all callbacks are called in the event loop.

    Args:
        runtime: Queues messages while a profile is applied.
        tasks: Paused while a profile is applied.
        on_applied: ``(profile, error)``: the profile's function has ended; ``error`` is empty if it succeeded.
        on_ended_late: ``(profile, touched, text)``: a function that was given up has ended. ``touched``: the present
            profile's function had begun by then, so the late one may have changed the device after it.
        on_late_action: ``(profile, text)``: a function that was given up has attempted an action, without effect.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        *,
        on_applied: Callable[[str, str], None],
        on_ended_late: Callable[[str, bool, str], None],
        on_late_action: Callable[[str, str], None],
    ) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._on_applied = on_applied
        self._on_ended_late = on_ended_late
        self._on_late_action = functools.partial(runtime.call_in_loop, on_late_action)
        self._call: FencedCall | None = None
        self._task: asyncio.Task[None] | None = None
        self._running: set[asyncio.Task[None]] = set()
        self._hanging: dict[FencedCall, None] = {}
        self._closed = False

    @property
    def hanging(self) -> list[str]:
        """Profiles whose functions were given up and still run."""
        return [call.name for call in self._hanging]

    def begin(self, profile: str) -> None:
        """Begin to apply a profile; the previous one must be complete or given up."""
        self._call = call = FencedCall("profile", profile, self._on_late_action)
        self._task = task = asyncio.get_running_loop().create_task(self._apply(call), name=f"apply {profile}")
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    def give_up(self) -> bool:
        """Give up the profile that is being applied; its queued messages are dropped.

        Returns:
            Whether its function still runs; ``on_ended_late`` is called when that ends.
        """
        call, task = self._call, self._task
        if call is None or task is None:
            return False
        _log.warning("! %s: profile %s hangs; it is given up", self._runtime.node.name, call.name)
        call.give_up()
        self._runtime.drop()
        if task.done():
            return False
        self._hanging[call] = None
        if not call.in_thread:
            task.cancel()
        return True

    def resume(self) -> None:
        """Resume tasks and messages after a profile was given up and no other one is being applied."""
        self._runtime.release()
        self._tasks.resume()

    async def wait(self) -> None:
        """Wait until the profile has been applied, at most 0.25 s."""
        if self._task is None or self._task.done():
            await asyncio.sleep(_WAIT_IDLE)
        else:
            await asyncio.wait([self._task], timeout=_WAIT)

    async def close(self) -> None:
        """Give up the profile that is being applied, if any; functions that hang in threads are left behind."""
        self._closed = True
        if self._call is not None:
            self._call.give_up()
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)

    # --- inside -------------------------------------------------------------------------------------------------

    async def _apply(self, call: FencedCall) -> None:
        why = ""
        try:
            await self._tasks.pause()
            if not call.closed:
                self._runtime.hold()
                await call.run(self._runtime.resource.profiles[call.name].apply)
        except asyncio.CancelledError:
            if self._closed or not call.closed:
                raise
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = f"{type(error).__name__}: {error}"
            _log.warning("! %s: profile %s: %s", self._runtime.node.name, call.name, why)
        if call.closed:
            self._ended_late(call)
            return
        if why:
            call.give_up()  # the function may have started coroutines and threads that still run
        self._runtime.release(drop=bool(why))
        self._tasks.resume()
        self._on_applied(call.name, why)

    def _ended_late(self, call: FencedCall) -> None:
        """Report that a given-up function has ended, and whether it may have undone the present profile."""
        self._hanging.pop(call, None)
        present = self._call
        touched = bool(call.began and present is not None and present is not call and present.began)
        took = asyncio.get_running_loop().time() - call.began if call.began else 0.0
        text = f"the function of profile {call.name}, which was given up, has ended after {took:.3g} s"
        self._on_ended_late(call.name, touched, text)
