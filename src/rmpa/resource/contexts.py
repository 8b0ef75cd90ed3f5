"""Switches a resource between its contexts: by hand (a topic, the configuration) or by the contexts' rules.

The context to be in is a function of the choice by hand and of the values that the rules refer to (``_wanted``),
which is evaluated whenever one of them may have changed. A switch is atomic: no task runs and no message is sent
until the context's function has ended, the context's outputs and requirements are in force, and the resulting profile
has been applied.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from typing import TYPE_CHECKING, Final

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource import limits
from rmpa.resource.declare import Context
from rmpa.resource.functions import HungError, call_function
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from rmpa.resource.adapter import Adapter
    from rmpa.resource.tasks import Tasks
    from rmpa.resource.values import ExpressionValues
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)
_HOLDER: Final = "context"
# Seconds from a change of a value until the rules are evaluated; changes within that time share one evaluation.
_DEBOUNCE: Final = 0.02
# Seconds between evaluations without a change: a dwell time may have ended, or a publisher may be gone.
_INTERVAL: Final = 0.25


class Contexts(RuntimePart):
    """The contexts of one resource; must be started after the adapter.

    Args:
        runtime: The runtime of the resource.
        values: The values that rules refer to.
        tasks: The resource's tasks, paused during a switch.
        adapter: Puts the requirements of contexts in force.
    """

    def __init__(self, runtime: Runtime, values: ExpressionValues, tasks: Tasks, adapter: Adapter) -> None:
        super().__init__(runtime)
        self._values = values
        self._tasks = tasks
        self._adapter = adapter
        self._known = runtime.resource.contexts
        # Name of the present context; empty: none.
        self.current = ""
        # Name of the context chosen by hand; empty: the rules decide. May be set before ``start``.
        self.chosen = ""
        # When the present context began, monotonic seconds.
        self._since = -math.inf
        self._rules = {name: one.when for name, one in self._known.items() if one.when is not None}
        self._retry = 0.0
        # Held during a switch, and from a choice to its outcome: one that fails must not undo the next.
        self._lock = asyncio.Lock()
        # Set when a value has changed that a rule refers to.
        self._change = asyncio.Event()
        # True before ``start`` and after ``close``.
        self._closed = True

    async def start(self) -> None:
        """Enter the chosen context, if any, and evaluate the rules from now on."""
        self._loop, self._closed = asyncio.get_running_loop(), False
        self._runtime.publish_text("context", "")
        if not self._known:
            return
        node = self._runtime.node
        await node.subscribe(f"{node.name}/set_context", MessageType("std_msgs/String"), self._choice_received)
        async with self._lock:
            try:
                await self._switch(self.chosen)
            except RmpaError as error:
                _log.warning("! %s: %s [resource-trouble]", node.name, error)
                self.chosen = ""
        if self._rules:
            self._values.on_change = self._values_changed
            self._work.add(keep_task(self._watch, "rules of contexts"))

    async def close(self) -> None:
        """Stop the evaluation of rules; the present context stays."""
        self._closed = True
        await super().close()

    def blocked(self) -> dict[str, str]:
        """The profiles that may not run in the present context."""
        allowed = self._known[self.current].profiles if self.current else ()
        barred = self._runtime.resource.profiles.keys() - allowed if allowed else ()
        return dict.fromkeys(barred, f"not in context {self.current}")

    async def choose(self, name: str) -> None:
        """Choose a context by hand; an empty name lets the rules decide again.

        Raises:
            ConfigError: The resource has no context of this name; nothing has changed.
            PeerRefused: The function of the context failed; the present context stays.
        """
        if name and name not in self._known:
            remedy = suggestion(name, self._known, f"it is one of {', '.join(self._known) or 'none'}")
            raise ConfigError(f"resource {self._runtime.resource.name}", f"no context {name[:80]!r}", remedy)
        async with self._lock:
            before, self.chosen = self.chosen, name
            if not name:
                self._since, self._retry = -math.inf, 0.0
            try:
                await self._switch(self._wanted(self._loop.time()))
            except RmpaError:
                if name:
                    self.chosen = before
                raise
            self._publish()

    def _wanted(self, now: float) -> str:
        """The context to be in: the one chosen by hand, or else the first whose rule holds; empty: none.

        One that a rule has selected stays at least ``limits.CONTEXT_DWELL`` seconds.
        """
        if self.chosen:
            return self.chosen
        if now - self._since < limits.CONTEXT_DWELL:
            return self.current
        values = self._values.now()
        return next((name for name, rule in self._rules.items() if rule.holds(values)), "")

    def _values_changed(self, references: set[str]) -> None:
        if any(not references.isdisjoint(rule.references) for rule in self._rules.values()):
            self._change.set()

    async def _watch(self) -> None:
        """Switch if the rules select another context: when a value has changed, and from time to time."""
        while True:
            async with self._lock:
                now = self._loop.time()
                try:
                    if now >= self._retry:
                        await self._switch(self._wanted(now))
                except RmpaError as error:
                    _log.warning("! %s: %s [resource-trouble]", self._runtime.node.name, error)
                    self._retry = self._loop.time() + limits.CONTEXT_RETRY
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_INTERVAL):
                    await self._change.wait()
                    await asyncio.sleep(_DEBOUNCE)
            self._change.clear()

    def _choice_received(self, message: Received) -> None:
        async def choose() -> None:
            try:
                await self.choose(str(message.message.data))
            except RmpaError as error:
                self._adapter.refuse(message.caller_id, printable(str(error)))

        self._work.start(choose(), "choose context")

    async def _switch(self, name: str) -> None:
        """Switch to a context.

        Raises:
            PeerRefused: The context's function failed; the resource stays in its present context.
            HungError: It did not return within ``limits.CONTEXT_ENTER_TIMEOUT`` seconds.
        """
        if name == self.current or self._closed:
            return
        runtime, context = self._runtime, self._known.get(name, Context(""))
        await self._tasks.pause(_HOLDER)
        runtime.hold(_HOLDER)
        try:
            if context.enter is not None:
                limit, remedy = limits.CONTEXT_ENTER_TIMEOUT, "mend it, or leave to a task what takes longer"
                await call_function(context.enter, "context", name, limit, remedy)
            runtime.context_outputs = context.outputs
            self.current, self._since = name, self._loop.time()
            self._adapter.enter_context(context)
            await self._adapter.settled()
        except HungError as error:
            runtime.release(_HOLDER, drop=True)
            self._adapter.end(error)
            raise
        except Exception as error:
            raise PeerRefused(f"context {name}", f"{type(error).__name__}: {error}") from error
        finally:
            runtime.release(_HOLDER)
            self._tasks.resume(_HOLDER)
        _log.info("= %s: %s", runtime.node.name, f"context {name}" if name else "no context any more")
        self._publish()

    def _publish(self) -> None:
        if not self._closed:
            self._runtime.publish_text("context", self.current)
            self._runtime.changed()
