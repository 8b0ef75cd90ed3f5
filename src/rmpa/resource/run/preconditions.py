"""Evaluates the preconditions of profiles (``needs=``), each in a thread of its own, because they may block."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.runtime.process import in_thread

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.behaviour import DeclaredProfile


class Preconditions:
    """The preconditions of one resource.

    Args:
        profiles: The declared profiles, by name.
    """

    def __init__(self, profiles: Mapping[str, DeclaredProfile]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        self._calls: dict[str, asyncio.Task[str | bool | None]] = {}
        """The call under way, by profile."""

    async def check(self) -> dict[str, str]:
        """Call all preconditions, except those whose last call has not returned; at most one check at a time.

        Returns:
            The profiles that must not run, with the reason, after ``limits.PRECONDITION_TIMEOUT`` seconds at most.
        """
        for name, needs in self._needs.items():
            if name not in self._calls:
                self._calls[name] = asyncio.create_task(in_thread(needs, f"needs of {name}"), name=f"needs of {name}")
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
        for call in self._calls.values():
            call.cancel()
        await asyncio.gather(*self._calls.values(), return_exceptions=True)
