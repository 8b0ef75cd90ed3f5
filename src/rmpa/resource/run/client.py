"""Asks a resource for a quality, and hears what it gives: here or in any other module.

::

    async with Node("driver") as node, ResourceClient(node, "sonar") as sonar:
        answer = await sonar.require(rate=at_least("20 Hz", hard=True), noise=at_most("5 cm"))
        print(answer.level.name, answer.message)
        async for answer in sonar.answers():
            ...
"""

from __future__ import annotations

import asyncio
import secrets
import time
from typing import TYPE_CHECKING, Any, Self

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.resource import limits
from rmpa.resource.declare.answer import RequirementAnswer
from rmpa.resource.declare.requirement_text import EXPIRES, PRIORITY
from rmpa.ros.types.diagnostic_array import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping
    from types import TracebackType

    from rmpa.resource.declare.resource import QoSRequest
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.topics import Publisher, Received, Subscriber


class ResourceClient:
    """One client of one resource; what it asked is forgotten when it ends.

    Args:
        node: Registered; one client of a resource a node.
        resource: The resource's node, as this module's graph has it: ``sonar``, ``/robot1/sonar``.
    """

    def __init__(self, node: Node, resource: str) -> None:
        self._node = node
        self.resource = resource if resource.startswith("/") else f"/{resource}"
        self._asking: Publisher | None = None
        self._observing: Publisher | None = None
        self._responses: Subscriber | None = None
        self._answer: RequirementAnswer | None = None
        self._mark = "none yet"
        self._version = 0
        self._change = asyncio.Event()

    async def __aenter__(self) -> Self:
        """Connect.

        Raises:
            UnreachableError: The master does not answer.
        """
        self._responses = await self._node.subscribe(
            f"{self.resource}/responses", MessageType(ARRAY_TYPE), self._heard
        )
        self._asking = await self._node.advertise(
            f"{self.resource}/requirements", MessageType(ARRAY_TYPE), latch=True
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for topic in (self._asking, self._observing, self._responses):
            if topic is not None:
                await topic.close()

    async def require(
        self,
        *,
        priority: int = 0,
        expires: str = "",
        timeout: float = limits.RESOURCE_ANSWER_TIMEOUT,  # noqa: ASYNC109 - the message names it
        **wishes: QoSRequest,
    ) -> RequirementAnswer:
        """Ask for a quality, in place of what was asked before; wait for what the resource says to it.

        Args:
            priority: The higher one wins a conflict between clients.
            expires: ``"60 s"``: forgotten after that; empty: when this client ends.
            timeout: Seconds to wait.
            wishes: By attribute; a qualified one (``ranges.rate``) is written ``ranges__rate``.

        Raises:
            PeerRefused: The request cannot be; what was asked before stays.
            UnreachableError: No such resource answers.
        """
        self.ask(priority=priority, expires=expires, **wishes)
        try:
            async with asyncio.timeout(timeout):
                while self._answer is None:
                    self._change.clear()
                    await self._change.wait()
        except TimeoutError:
            remedy = "`rmpa resource list` shows which there are"
            raise UnreachableError("resource", f"{self.resource} ({timeout:g} s)", remedy) from None
        if self._answer.level is DiagnosticLevel.ERROR and "non-adaptable" not in self._answer.message:
            raise PeerRefused(f"resource {self.resource}", self._answer.message)
        return self._answer

    def ask(self, *, priority: int = 0, expires: str = "", **wishes: QoSRequest) -> None:
        """Ask as ``require`` does, without waiting: ``answers`` tells."""
        values = {name.replace("__", "."): str(wish) for name, wish in wishes.items()}
        if priority:
            values[PRIORITY] = str(priority)
        if expires:
            values[EXPIRES] = expires
        self._say(values)

    @property
    def there(self) -> bool:
        """Whether such a resource is connected."""
        return self._responses is not None and self._responses.publishers > 0

    async def observe(self, **values: float | str) -> None:
        """Say what this client observes of what it is given: ``await sonar.observe(rate="12 Hz")``, again and again.

        The resource measures what it sends; what comes here may be less, and that is what it is to adapt to. It
        counts beside a requirement of the same client, for three of the resource's quality windows.

        Args:
            values: By attribute, as in ``require``; a number is in the attribute's unit.

        Raises:
            UnreachableError: The master does not answer.
        """
        if self._observing is None:
            self._observing = await self._node.advertise(f"{self.resource}/observed", MessageType(ARRAY_TYPE))
        if values:
            self.report(**values)

    def report(self, **values: float | str) -> None:
        """As ``observe``, behind a first one.

        Raises:
            UnreachableError: There was no first one.
        """
        if self._observing is None:
            raise UnreachableError("resource", self.resource, "await observe() once before")
        pairs: Any = [{"key": key.replace("__", "."), "value": str(value)} for key, value in values.items()]
        status: Any = [{"name": self._node.name, "values": pairs}]
        self._observing.publish(self._observing.make({"header": {"stamp": time.time()}, "status": status}))

    def release(self) -> None:
        """Ask for nothing any more."""
        self._say({})

    @property
    def answer(self) -> RequirementAnswer | None:
        """The last one."""
        return self._answer

    async def answers(self) -> AsyncIterator[RequirementAnswer]:
        """The present answer, if there is one, and each from now on, as it changes."""
        seen = 0
        while True:
            while self._version == seen:
                self._change.clear()
                await self._change.wait()
            seen = self._version
            if self._answer is not None:
                yield self._answer

    # --- inside -------------------------------------------------------------------------------------------------

    def _say(self, values: Mapping[str, str]) -> None:
        if self._asking is None:
            raise UnreachableError("resource", self.resource, "enter the client first: async with ResourceClient(…)")
        pairs: Any = [{"key": key, "value": value} for key, value in values.items()]
        self._mark = secrets.token_hex(8)
        self._answer = None
        status: Any = [{"name": self._node.name, "hardware_id": self._mark, "values": pairs}]
        # By its stamp a latched request that comes again is known, and its expiry does not begin anew.
        self._asking.publish(self._asking.make({"header": {"stamp": time.time()}, "status": status}))

    def _heard(self, received: Received) -> None:
        for status in received.message.status:
            # The resource's graph may know us by another name (a proxy's); the mark is ours alone.
            if status.hardware_id == self._mark:
                values = {str(pair.key): str(pair.value) for pair in status.values}
                answer = RequirementAnswer(DiagnosticLevel(int(status.level)), str(status.message), values)
                if answer != self._answer:
                    self._answer = answer
                    self._version += 1
                    self._change.set()
