"""Queries of other sites and of ROS 2, each answered by a coroutine."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.core.errors import PeerRefused, RmpaError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rmpa.gateway.zenoh.config import ArrivedQuery

    Respond = Callable[[ArrivedQuery], Awaitable[tuple[bytes, bytes]]]

_T = TypeVar("_T")
_log = logging.getLogger(__name__)


class OwnedTasks:
    """Tasks that end together; the failure of one is logged."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def __len__(self) -> int:
        """Those that run now."""
        return len(self._tasks)

    def spawn(self, work: Coroutine[Any, Any, _T], name: str = "") -> asyncio.Task[_T]:
        """Run a coroutine in the background."""
        task = asyncio.get_running_loop().create_task(work, name=name or None)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def cancel(self) -> None:
        """End them all."""
        for task in self._tasks:
            task.cancel()

    async def close(self) -> None:
        """End them all, and wait for it."""
        self.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.error("! a task of the gateway ended with an error", exc_info=error)


class Answering(OwnedTasks):
    """Answers queries in tasks, a bounded number at once; an error is the reply, and the end of the gateway too.

    Args:
        what: What is asked for, for the log and for texts.
        ends: What is answered if the gateway ends meanwhile.
        most: Queries that are answered at once, or wait.
    """

    def __init__(self, what: str, ends: str, most: int) -> None:
        self._what: Final = what
        self._ends: Final = ends
        self._most: Final = most
        super().__init__()

    def take(self, query: ArrivedQuery, respond: Respond) -> bool:
        """Answer a query by what ``respond`` returns for it: the payload, and its attachment (empty for none).

        Returns:
            Whether there was room.
        """
        if len(self) >= self._most:
            query.reply_error(f"{len(self)} calls of {self._what} wait already; try again later")
            return False
        self.spawn(self._answer(query, respond), f"answer for {self._what}")
        return True

    async def _answer(self, query: ArrivedQuery, respond: Respond) -> None:
        try:
            query.reply(query.key, *(await respond(query)))
            query.finish()
        except PeerRefused as error:
            query.reply_error(error.reason)
        except RmpaError as error:
            query.reply_error(str(error))
        except asyncio.CancelledError:
            query.reply_error(self._ends)
            raise
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! an answer for %s failed", self._what)
            query.reply_error(f"the gateway failed at {self._what}; its log says why")
