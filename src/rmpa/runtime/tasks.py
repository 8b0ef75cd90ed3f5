"""The one place that starts tasks: the failure of each is logged, and what must run for ever is started again."""

from __future__ import annotations

import asyncio
import logging
import random
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.core.timers import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

_log = logging.getLogger(__name__)

_T = TypeVar("_T")
# Seconds after which a kept task that failed runs again; they grow to the second value while it fails. What fails
# is a fault of the program, so each attempt logs a traceback.
_KEEP_FIRST: Final = 1.0
_KEEP_MAX: Final = 30.0


def start_task(
    work: Coroutine[Any, Any, _T], name: str, *, raises: tuple[type[Exception], ...] = ()
) -> asyncio.Task[_T]:
    """Start a task; an error that ends it is logged as a fault.

    Args:
        work: What it does.
        name: What the log calls it.
        raises: Errors that are its result: its owner awaits them, and they are not logged.
    """

    def ended(task: asyncio.Task[_T]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None and not isinstance(error, raises):
            _log.error("! %s failed", name, exc_info=error)

    task = asyncio.get_running_loop().create_task(work, name=name)
    task.add_done_callback(ended)
    return task


def keep_task(run: Callable[[], Coroutine[Any, Any, None]], name: str) -> asyncio.Task[None]:
    """Start what must go on until it returns or is cancelled: an error is logged, and it runs again after a pause."""

    async def keep() -> None:
        loop, backoff = asyncio.get_running_loop(), Backoff(_KEEP_FIRST, _KEEP_MAX, random.random)
        while True:
            began = loop.time()
            try:
                return await run()
            except Exception:  # noqa: BLE001 - the one top of what must go on
                if loop.time() - began > _KEEP_MAX:
                    backoff.reset()
                delay = backoff.delay()
                _log.exception("! %s failed; it goes on in %.1f s", name, delay)
            await asyncio.sleep(delay)

    return start_task(keep(), name)


async def end_tasks(*tasks: asyncio.Task[Any] | None) -> None:
    """Cancel tasks, and wait until they have ended; ``None`` is one that was not started."""
    started = [task for task in tasks if task is not None]
    for task in started:
        task.cancel()
    if started:
        await asyncio.wait(started)


class OwnedTasks(set[asyncio.Task[Any]]):
    """The tasks of one owner that run now; they end together."""

    def start(
        self, work: Coroutine[Any, Any, _T], name: str, *, raises: tuple[type[Exception], ...] = ()
    ) -> asyncio.Task[_T]:
        """Start one as ``start_task`` does."""
        task = start_task(work, name, raises=raises)
        self.add(task)
        task.add_done_callback(self.discard)
        return task

    def cancel(self) -> None:
        """Cancel them all."""
        for task in self:
            task.cancel()

    async def close(self) -> None:
        """Cancel them all, and wait until they have ended."""
        await end_tasks(*self)
