"""Applies profiles: each between two runs of the tasks, and one that hangs without harm to the next one.

A plain function that hangs cannot be ended. It is given up: what it does later through the resource has no effect
(``resource.declare.fence``), and when it ends the profile that runs is applied once more, for it may have touched
the device itself. Until then its own profile is left out, since two calls of one function would mix.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.resource.run.fenced_call import Call

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks

_log = logging.getLogger(__name__)
_LOOK: Final = 0.25
_SOON: Final = 0.02


class Applier:
    """Of one resource; what it calls it calls in the loop.

    Args:
        runtime: Keeps what is published meanwhile.
        tasks: Paused meanwhile.
        on_applied: ``(profile, why)``: its function has ended; ``why`` says what was wrong, or nothing.
        on_ended_late: ``(profile, touched, text)``: a function that was given up has ended, and may have touched the
            device since the present profile's function began.
        on_late: ``(profile, text)``: one that was given up did something, without effect.
    """

    def __init__(
        self,
        runtime: Runtime,
        tasks: Tasks,
        *,
        on_applied: Callable[[str, str], None],
        on_ended_late: Callable[[str, bool, str], None],
        on_late: Callable[[str, str], None],
    ) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._on_applied = on_applied
        self._on_ended_late = on_ended_late
        self._on_late = on_late
        self._call: Call | None = None
        self._task: asyncio.Task[None] | None = None
        self._running: set[asyncio.Task[None]] = set()
        self._hanging: dict[Call, None] = {}
        self._closed = False

    @property
    def hanging(self) -> list[str]:
        """Profiles whose functions were given up and still run."""
        return [call.name for call in self._hanging]

    def begin(self, profile: str) -> None:
        """Apply a profile; none is being applied, or it was given up."""
        self._call = call = Call("profile", profile, self._stopped)
        self._task = task = asyncio.get_running_loop().create_task(self._apply(call), name=f"apply {profile}")
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    def give_up(self) -> bool:
        """Do not wait for the function that runs any longer; its messages are dropped.

        Returns:
            Whether it goes on; ``on_ended_late`` tells when it ends.
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

    def let_go(self) -> None:
        """Nothing is applied any more after one was given up: let the tasks and the messages go on."""
        self._runtime.release()
        self._tasks.resume()

    async def wait(self) -> None:
        """Wait until the profile that is being applied is, or for a moment."""
        if self._task is None or self._task.done():
            await asyncio.sleep(_SOON)  # it died; it is given up at its time-out
        else:
            await asyncio.wait([self._task], timeout=_LOOK)

    async def close(self) -> None:
        """Apply nothing any more; what hangs in a thread is left behind."""
        self._closed = True
        if self._call is not None:
            self._call.give_up()
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)

    # --- inside -------------------------------------------------------------------------------------------------

    async def _apply(self, call: Call) -> None:
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
            call.give_up()  # what it has begun may go on: coroutines, threads
        self._runtime.release(drop=bool(why))
        self._tasks.resume()
        self._on_applied(call.name, why)

    def _ended_late(self, call: Call) -> None:
        """The device may be as this function left it, and not as is said."""
        self._hanging.pop(call, None)
        present = self._call
        touched = bool(call.began and present is not None and present is not call and present.began)
        took = asyncio.get_running_loop().time() - call.began if call.began else 0.0
        text = f"the function of profile {call.name}, which was given up, has ended after {took:.3g} s"
        self._on_ended_late(call.name, touched, text)

    def _stopped(self, call: Call, what: str) -> None:
        """In any thread."""
        self._runtime.call_in_loop(self._say_stopped, call, what)

    def _say_stopped(self, call: Call, what: str) -> None:
        if what not in call.said:
            call.said.add(what)
            self._on_late(call.name, f"the function of profile {call.name} was given up; it has no effect: {what}")
