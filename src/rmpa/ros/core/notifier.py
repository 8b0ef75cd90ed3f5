"""Sends the master's notifications to slave APIs: in order and one at a time to each, independently of the others.

rosmaster has three threads for all slaves, so three stopped nodes stop every notification; here each URI has its own
queue. For each topic only the latest list of publishers is queued. Parameter updates are all sent, until
``limits.NOTIFY_COALESCE`` notifications wait; from then on a newer update of a parameter replaces an older one.
"""

from __future__ import annotations

import asyncio
import logging
import random
from typing import TYPE_CHECKING, TypeAlias

from rmpa.core.counters import Backoff
from rmpa.core.errors import LocalProtocolError, OutOfDescriptors, RemoteProtocolError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core.identify import name_at
from rmpa.ros.http.client import call
from rmpa.ros.master.effects import Effect, ParamUpdate, PublisherUpdate, Shutdown
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.accept import Use

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)

MASTER_ID = "/master"
"""The caller id of masters in calls to slaves."""

_Key: TypeAlias = tuple[type[Effect], str, int]


class Notifier:
    """One queue for each slave API, emptied by a task that runs while there is something in it.

    Args:
        nodes_at: Returns the nodes that are registered with a slave API; a failed notification is not sent again if
            there are none.
        on_unreachable: Called with a slave API that did not answer: its nodes may be dead.
        counters: ``notify.sent``, ``notify.failed``, ``notify.dropped``.
    """

    def __init__(
        self,
        *,
        nodes_at: Callable[[str], list[str]],
        on_unreachable: Callable[[str], None],
        counters: Counters,
    ) -> None:
        self._nodes_at = nodes_at
        self._on_unreachable = on_unreachable
        self._counters = counters
        self._queues: dict[str, dict[_Key, Effect]] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._closed = False
        self._serial = 0

    @property
    def waiting(self) -> int:
        """Notifications in the queues."""
        return sum(map(len, self._queues.values()))

    def add(self, effect: Effect) -> None:
        """Queue a notification; a task sends it, never this call."""
        if self._closed:
            return
        queue = self._queues.setdefault(effect.api, {})
        key = self._key(effect, len(queue))
        # Moved to the end: updates of nested parameters overlap, so a newer one must also be sent later.
        queue.pop(key, None)
        queue[key] = effect
        if len(queue) > limits.NOTIFY_QUEUE_MAX:
            del queue[next(iter(queue))]
            self._counters.add("notify.dropped")
        if effect.api not in self._tasks:
            self._tasks[effect.api] = asyncio.get_running_loop().create_task(
                self._empty(effect.api, queue), name=f"notify {effect.api}"
            )

    def _key(self, effect: Effect, waiting: int) -> _Key:
        """The key by which a newer notification replaces an older one."""
        match effect:
            case PublisherUpdate(topic=name) | Shutdown(node=name):
                return type(effect), name, 0
            case ParamUpdate(key=name):
                self._serial += 1
                return ParamUpdate, name, self._serial if waiting < limits.NOTIFY_COALESCE else 0

    async def close(self) -> None:
        """Stop at once; queued notifications are not sent."""
        self._closed = True
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _empty(self, api: str, queue: dict[_Key, Effect]) -> None:
        backoff = Backoff(limits.NOTIFY_RETRY_FIRST, limits.NOTIFY_RETRY_MAX, random.random)
        try:
            while queue:
                key = next(iter(queue))
                effect = queue.pop(key)
                if await self._sent(effect):
                    backoff.reset()
                elif isinstance(effect, Shutdown):
                    continue
                elif not self._nodes_at(api):
                    queue.clear()
                else:
                    if key not in queue:
                        rest = dict(queue)
                        queue.clear()
                        queue.update({key: effect, **rest})
                    await asyncio.sleep(backoff.delay())
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! notifications to %s failed", api)
        finally:
            del self._queues[api], self._tasks[api]

    async def _sent(self, effect: Effect) -> bool:
        """Send one; return whether it need not be sent again."""
        try:
            await self._send(effect)
        except OutOfDescriptors as error:
            # The shortage is this process's, and is reported elsewhere: the node may be well.
            self._counters.add("notify.failed")
            _log.debug("! %s", error)
            return False
        except UnreachableError as error:
            self._counters.add("notify.failed")
            _log.info("! %s", error)
            self._on_unreachable(effect.api)
            return False
        except (RosFault, RemoteProtocolError, LocalProtocolError) as error:
            # The node got it, or never will: sending again would not help.
            self._counters.add("notify.failed")
            _log.info("! %s: %s", effect.api, error)
        else:
            self._counters.add("notify.sent")
        return True

    async def _send(self, effect: Effect) -> None:
        match effect:
            case PublisherUpdate(api, topic, publishers):
                _log.debug("> %s publisherUpdate %s %s", api, topic, publishers)
                await call(api, "publisherUpdate", MASTER_ID, topic, list(publishers), use=Use.CORE)
            case ParamUpdate(api, key, value):
                _log.debug("> %s paramUpdate %s", api, key)
                await call(api, "paramUpdate", MASTER_ID, key, value, use=Use.CORE)
            case Shutdown():
                await self._shut_down(effect)

    async def _shut_down(self, effect: Shutdown) -> None:
        """Ask a node whose name another node has taken to end, unless its address is another node's by now."""
        found = await name_at(effect.api, effect.topics)
        if found is None and self._nodes_at(effect.api):
            found = self._nodes_at(effect.api)[0]
        if found is not None and found != effect.node:
            _log.info("= %s is not asked to end: %s is at %s now", effect.node, found, effect.api)
            self._counters.add("notify.stale")
            return
        _log.warning("> %s at %s is asked to end: another node has its name", effect.node, effect.api)
        reason = f"[{effect.node}] Reason: new node registered with same name"
        await call(effect.api, "shutdown", MASTER_ID, reason, use=Use.CORE)
