"""Asks the preconditions of profiles (``needs=``), each in a thread of its own: one that blocks holds up nobody."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare.resource import DeclaredProfile


class Preconditions:
    """Those of one resource.

    Args:
        profiles: By name; those without a precondition are left alone.
        on_change: Called in the loop when an answer is another one than before.
    """

    def __init__(self, profiles: Mapping[str, DeclaredProfile], on_change: Callable[[], None]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        self._on_change = on_change
        self._started = False
        self._answers: dict[str, str] = {}
        """By profile: why it cannot be taken, or empty."""
        self._asked: dict[str, tuple[float, asyncio.Task[None]]] = {}
        """By profile whose answer is waited for: since when."""

    async def start(self) -> None:
        """Have the first answers, or as many as come within ``limits.PRECONDITION_TIMEOUT``."""
        self.look()
        if self._asked:
            await asyncio.wait([task for _, task in self._asked.values()], timeout=limits.PRECONDITION_TIMEOUT)
        self._started = True

    def look(self) -> None:
        """Ask again; one that has not answered yet is not asked a second time."""
        loop = asyncio.get_running_loop()
        for name, needs in self._needs.items():
            if name not in self._asked:
                self._asked[name] = (loop.time(), loop.create_task(self._ask(name, needs), name=f"needs of {name}"))

    def barred(self) -> dict[str, str]:
        """The profiles that cannot be taken, and why; as was answered last."""
        now, found = asyncio.get_running_loop().time(), {}
        for name in self._needs:
            why = self._answers.get(name, "its precondition was not answered yet")
            since = self._asked[name][0] if name in self._asked else now
            if now - since > limits.PRECONDITION_TIMEOUT:
                why = f"its precondition has not answered for {limits.PRECONDITION_TIMEOUT:g} s"
            if why:
                found[name] = why
        return found

    async def close(self) -> None:
        """Ask nothing any more; threads that hang are left behind."""
        tasks = [task for _, task in self._asked.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _ask(self, name: str, needs: Callable[[], str | bool | None]) -> None:
        try:
            answer = await in_thread(needs, f"needs of {name}")
        except Exception as error:  # noqa: BLE001 - the user's code
            answer = f"its precondition failed: {type(error).__name__}: {error}"
        since, _ = self._asked.pop(name)
        why = "its precondition does not hold" if answer is False else answer if isinstance(answer, str) else ""
        late = asyncio.get_running_loop().time() - since > limits.PRECONDITION_TIMEOUT
        if late or why != self._answers.get(name):
            self._answers[name] = why
            if self._started:
                self._on_change()
