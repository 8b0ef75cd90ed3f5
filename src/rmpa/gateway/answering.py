"""Queries of other sites and of ROS 2, each answered by a coroutine."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import PeerRefused, RmpaError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.gateway.zenoh.config import ArrivedQuery

    Respond = Callable[[ArrivedQuery], Awaitable[tuple[bytes, bytes]]]

_log = logging.getLogger(__name__)


class Answering:
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
        self._tasks: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        """The queries that are answered now, or wait."""
        return len(self._tasks)

    def take(self, query: ArrivedQuery, respond: Respond) -> bool:
        """Answer a query by what ``respond`` returns for it: the payload, and its attachment (empty for none).

        Returns:
            Whether there was room.
        """
        if len(self._tasks) >= self._most:
            query.reply_error(f"{len(self._tasks)} calls of {self._what} wait already; try again later")
            return False
        task = asyncio.get_running_loop().create_task(self._answer(query, respond), name=f"answer for {self._what}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return True

    def cancel(self) -> None:
        """End what is under way, with an error."""
        for task in self._tasks:
            task.cancel()

    async def close(self) -> None:
        """Do so, and wait for it."""
        self.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

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
