"""Evaluates the preconditions of profiles (``needs=``), each in a thread of its own, because they may block."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare.behaviour import DeclaredProfile


class Preconditions:
    """The preconditions of one resource.

    Args:
        profiles: The declared profiles, by name.
        on_change: Called in the event loop when a result has changed or has arrived late.
    """

    def __init__(self, profiles: Mapping[str, DeclaredProfile], on_change: Callable[[], None]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        self._on_change = on_change
        self._started = False
        self._results: dict[str, str] = {}
        """The last result by profile: why the profile must not run; empty: it may."""
        self._calls: dict[str, tuple[float, asyncio.Task[None]]] = {}
        """The call under way by profile, with its beginning in seconds of the event loop's clock."""

    async def start(self) -> None:
        """Call all preconditions and wait for the results, at most ``limits.PRECONDITION_TIMEOUT`` seconds."""
        self.check()
        if self._calls:
            await asyncio.wait([task for _, task in self._calls.values()], timeout=limits.PRECONDITION_TIMEOUT)
        self._started = True

    def check(self) -> None:
        """Call all preconditions, except those whose last call has not returned."""
        loop = asyncio.get_running_loop()
        for name, needs in self._needs.items():
            if name not in self._calls:
                self._calls[name] = (loop.time(), loop.create_task(self._call(name, needs), name=f"needs of {name}"))

    def blocked(self) -> dict[str, str]:
        """The profiles that must not run, with the reason: by their last results, or because none has arrived."""
        now, found = asyncio.get_running_loop().time(), {}
        for name in self._needs:
            why = self._results.get(name, "its precondition was not answered yet")
            since = self._calls[name][0] if name in self._calls else now
            if now - since > limits.PRECONDITION_TIMEOUT:
                why = f"its precondition has not answered for {limits.PRECONDITION_TIMEOUT:g} s"
            if why:
                found[name] = why
        return found

    async def close(self) -> None:
        """Stop waiting for calls; threads that hang are left behind."""
        tasks = [task for _, task in self._calls.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _call(self, name: str, needs: Callable[[], str | bool | None]) -> None:
        try:
            answer = await in_thread(needs, f"needs of {name}")
        except Exception as error:  # noqa: BLE001 - the user's code
            answer = f"its precondition failed: {type(error).__name__}: {error}"
        since, _ = self._calls.pop(name)
        why = "its precondition does not hold" if answer is False else answer if isinstance(answer, str) else ""
        late = asyncio.get_running_loop().time() - since > limits.PRECONDITION_TIMEOUT
        if late or why != self._results.get(name):
            self._results[name] = why
            if self._started:
                self._on_change()
