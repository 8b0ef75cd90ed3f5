"""Waiting in the event loop for what comes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Final

DEADLINE: Final = 30.0


async def until(condition: Callable[[], Any], what: str = "it does not come", within: float = DEADLINE) -> Any:
    """Let the loop turn until something holds; return what the condition did."""
    try:
        async with asyncio.timeout(within):
            while not (found := condition()):
                await asyncio.sleep(0.001)
            return found
    except TimeoutError:
        raise AssertionError(what) from None
