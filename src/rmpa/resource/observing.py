"""Measures topics that other nodes publish and receive: nothing of them is passed on.

A topic is measured by subscribing to it, as any node does. A second subscriber of much data costs the publisher, so
such a topic is measured by what its publishers count themselves (``getBusStats``): rate and bandwidth to their other
subscribers. Whether a topic has a publisher at all is asked of the master where there is no subscription.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.declare import Measure
from rmpa.resource.runtime import RuntimePart, topic_of
from rmpa.ros.http.rpc import call, call_api, exchange, read_response
from rmpa.ros.wire.slave_api import read_bus_stats
from rmpa.ros.wire.tcpros import printable
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, call_pieces
from rmpa.runtime.tasks import OwnedTasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.resource.declare import Output
    from rmpa.resource.runtime import Runtime
    from rmpa.resource.values import ExpressionValues
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.wire.slave_api import Sent

_log = logging.getLogger(__name__)
# The data of so many seconds decide whether a topic carries much; a latched message that comes once does not count.
_SPAN: Final = 5.0
# Seconds between two questions to nodes and master: at least, and where windows are longer.
_LEAST: Final = 0.2
_MOST: Final = 1.0
# Seconds for a node's answer.
_ANSWER: Final = 1.0


class Observing(RuntimePart):
    """The observed topics of one resource, and the nodes that others start for it; starts before the adapter.

    Args:
        runtime: The runtime of the resource.
        values: A topic that an expression names stays subscribed to.
    """

    def __init__(self, runtime: Runtime, values: ExpressionValues) -> None:
        self._runtime = runtime
        self._values = values
        # Called with an output, and what each of its publishers has sent, and when.
        self.on_counts: Callable[[str, Mapping[str, Sent], float], None] = lambda _output, _sent, _now: None
        # All nodes that the master knows.
        self._present: set[str] = set()
        resource, node = runtime.resource, runtime.node.name
        outputs = list(enumerate(resource.outputs.values()))
        # Observed outputs, and those of them that are counted, by global name.
        self._outputs = {topic_of(one.name, node): one for one in resource.outputs.values() if one.observed}
        self._counted: dict[str, Output] = {}
        # Outputs without which a profile does, for it offers no messages of them.
        prefixes = {one.name: (f"{resource.labels[one.name]}.", *([""] if not n else [])) for n, one in outputs}
        offers = [one.offers for one in resource.profiles.values()]
        self._optional = {
            name
            for name, each in prefixes.items()
            if any(o.get(f"{prefix}rate") == 0 for o in offers for prefix in each)
        }
        # Required inputs that other nodes receive, by global name.
        self._inputs = {
            topic_of(one.name, node): one.name for one in resource.inputs.values() if one.observed and one.required
        }
        # By output: when the first of the messages that decide has come, and the bytes of the later ones.
        self._carried: dict[str, tuple[float, int]] = {}
        # The publishers of each topic as the master last said; ``None``: it has not been asked.
        self._publishers: Mapping[str, Sequence[str]] | None = None
        self._said = b""
        self._uris: dict[str, str] = {}
        self._work = OwnedTasks()

    async def start(self) -> None:
        """Subscribe, or begin to ask for counters."""
        self._loop = asyncio.get_running_loop()
        for topic, output in self._outputs.items():
            if output.measure is Measure.COUNTERS:
                self._counted[topic] = output
            else:
                await self._runtime.observe(output, functools.partial(self._received, output))
        if self._outputs or self._inputs or self._runtime.resource.nodes:
            with contextlib.suppress(RmpaError):
                await self._look()
            self._work.add(keep_task(self._watch, f"observe for {self._runtime.resource.name}"))

    async def close(self) -> None:
        """Measure no more."""
        await self._work.close()

    def problems(self) -> tuple[list[str], list[str]]:
        """Topics that no node publishes, and publishers of another type."""
        absent, named = self._absent()
        missing, broken = [f"node {name} does not run" for key, name in absent.items() if key not in named], []
        for topic, output in self._outputs.items():
            subscriber = self._runtime.subscriber(output.name)
            if subscriber is None and (self._publishers is None or self._publishers.get(topic)):
                continue
            if (subscriber is None or not subscriber.publishers) and output.name not in self._optional:
                missing.append(f"no node publishes {output.name}")
                refusals = [*subscriber.refusals.values()][-1:] if subscriber is not None else []
                broken += [f"{output.name}: {printable(text)}" for text in refusals]
        if self._publishers is not None:
            missing += [
                f"no node publishes {name}" for topic, name in self._inputs.items() if not self._publishers.get(topic)
            ]
        return missing, broken

    def blocked(self) -> dict[str, str]:
        """The profiles that cannot run, with the reason: a node does not run that nothing here starts."""
        absent, named = self._absent()
        return {
            one.name: f"node {name} does not run"
            for one in self._runtime.resource.profiles.values()
            for key, name in absent.items()
            if key not in named or key in one.nodes
        }

    def _absent(self) -> tuple[dict[str, str], set[str]]:
        """The nodes that nothing here starts and that do not run, by their keys, and those that profiles name."""
        resource = self._runtime.resource
        others = {one.key: one.name for one in resource.nodes.values() if not one.started and self._said}
        named = {key for one in resource.profiles.values() for key in one.nodes}
        return {key: name for key, name in others.items() if name not in self._present}, named

    def _received(self, output: Output, message: Received) -> None:
        """Change to counters if the topic carries much."""
        now, size = self._loop.time(), len(message.raw)
        began, carried = self._carried.get(output.name, (-_SPAN, 0))
        carried = carried + size if now - began < _SPAN else 0
        self._carried[output.name] = (began if carried else now), carried
        topic = topic_of(output.name, self._runtime.node.name)
        much = output.measure is Measure.AUTO and carried > limits.MEASURED_BYTES * max(1.0, now - began)
        if not much or topic in self._counted or self._values.uses(output.name):
            return
        self._counted[topic] = output
        self.on_counts(output.name, {}, now)
        self._work.start(self._runtime.ignore(output.name), f"measure {output.name} by counters")
        text = f"more than {limits.MEASURED_BYTES // 1024} KiB a second; it is measured by its node's own counters"
        _log.info("= %s: %s carries %s: rate and bandwidth only", self._runtime.node.name, output.name, text)

    async def _watch(self) -> None:
        period = min(max(self._runtime.resource.settings.window, _LEAST), _MOST)
        while True:
            try:
                if self._counted or self._inputs or self._runtime.resource.nodes:
                    await self._look()
                    await self._count(self._publishers or {})
            except (RmpaError, RosFault) as error:
                _log.debug("! %s: %s", self._runtime.node.name, error)
            await asyncio.sleep(period)

    async def _look(self) -> None:
        """Ask the master which nodes publish what; the same answer as before is not read again."""
        node = self._runtime.node
        question = b"".join(call_pieces("getSystemState", [node.name]))
        said = await exchange(node.master_uri, "getSystemState", question, timeout=_ANSWER * 5)
        if said == self._said:
            return
        match RosReply.of(await read_response(said)).value:
            case [[*published], [*subscribed], [*served]]:
                known = {str(topic): list(map(str, names)) for topic, names in published}  # type: ignore[misc, arg-type]
                mine = self._outputs.keys() | self._inputs.keys()
                self._publishers = {topic: [n for n in known.get(topic, ()) if n != node.name] for topic in mine}
                self._present = {str(name) for _, names in (*published, *subscribed, *served) for name in names}  # type: ignore[misc, union-attr]
                self._said, self._uris = said, {}

    async def _count(self, publishers: Mapping[str, Sequence[str]]) -> None:
        """Ask the publishers of counted topics for their counters."""
        nodes = [*dict.fromkeys(name for topic in self._counted for name in publishers.get(topic, ()))]
        answers = dict(zip(nodes, await asyncio.gather(*map(self._ask, nodes)), strict=True))
        for topic, output in self._counted.items():
            names = publishers.get(topic, ())
            sent = {name: found.get(topic, {}) for name in names if (found := answers.get(name)) is not None}
            self.on_counts(output.name, sent, self._loop.time())

    async def _ask(self, node: str) -> dict[str, Sent] | None:
        """What a node has sent, by topic; ``None`` if it does not answer."""
        own = self._runtime.node
        try:
            if node not in self._uris:
                self._uris[node] = str((await call_api(own.master_uri, "lookupNode", own.name, node)).value)
            return read_bus_stats(await call(self._uris[node], "getBusStats", own.name, timeout=_ANSWER))
        except (RmpaError, RosFault) as error:
            _log.debug("! %s: counters of %s: %s", own.name, node, error)
            return None
