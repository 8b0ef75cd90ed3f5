"""A running resource: its node, its parts and its life cycle."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.resource.actuation import Actuation
from rmpa.resource.adapter import Adapter
from rmpa.resource.client import Demands
from rmpa.resource.contexts import Contexts
from rmpa.resource.functions import call_hook
from rmpa.resource.measuring import Measuring
from rmpa.resource.processes import Processes
from rmpa.resource.reconfigure import Reconfigure
from rmpa.resource.runtime import LifecycleState, Runtime
from rmpa.resource.saved import Persistence, SavedCoolDown, SavedState
from rmpa.resource.tasks import Tasks
from rmpa.resource.values import ExpressionValues
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.fetch_type import fetch_type
from rmpa.ros.node.node import Node
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.resource.declare import Output
    from rmpa.resource.resource import Resource

_log = logging.getLogger(__name__)

# Time between two checks of a resource whether a publisher of a type that it needs has appeared.
TYPE_LOOK: Final = 1.0
_UNCONFIGURED, _INACTIVE, _ACTIVE, _FINALIZED = LifecycleState
# The states from which each transition of the life cycle is valid, and the one to which it leads.
TRANSITIONS: Final = {
    "configure": ((_UNCONFIGURED,), _INACTIVE),
    "activate": ((_INACTIVE,), _ACTIVE),
    "deactivate": ((_ACTIVE,), _INACTIVE),
    "finalize": ((_UNCONFIGURED, _INACTIVE, _ACTIVE), _FINALIZED),
}


class ResourceNode:
    """Runs one resource on the core of its module.

    Args:
        resource: The resource, completely declared.
        master_uri: URI of the core's master.
        state: The file that keeps the resource's state over a restart; ``None``: nothing is kept.
        stop: Set when a function of a profile or context has exceeded its time-out: the resource has to end.

    Raises:
        ConfigError: The resource declares no profile, so there is nothing to decide.
    """

    def __init__(
        self, resource: Resource, master_uri: str, *, state: Path | None = None, stop: asyncio.Event | None = None
    ) -> None:
        if not resource.profiles:
            remedy = "declare one: @NAME.profile(offers={…})"
            raise ConfigError(f"resource {resource.name}", "it has no System Profile", remedy)
        self.resource = resource
        # Set when the resource is finalized, or when its node is shut down from outside.
        self.ended = asyncio.Event()
        node = Node(resource.name, master_uri=master_uri, on_shutdown=lambda _reason: self.ended.set())
        self.runtime = Runtime(resource, node)
        self.runtime.close_outputs()
        self.processes = Processes(self.runtime, state.parent if state is not None else None)
        self.tasks = Tasks(self.runtime, self._deactivate_soon)
        self.values = ExpressionValues(self.runtime, self.processes)
        self.actuation = Actuation(self.runtime, self.processes)
        measuring = Measuring(self.runtime, self.values)
        stop = stop if stop is not None else asyncio.Event()
        self.adapter = Adapter(self.runtime, self.values, self.tasks, self.actuation, measuring, stop)
        self.processes.on_change = self.adapter.node_changed
        self.contexts = Contexts(self.runtime, self.values, self.tasks, self.adapter)
        self.configuration = Reconfigure(self.runtime, self.tasks, self.actuation, self.adapter, self.contexts)
        self.demands = Demands(self.runtime)
        self.runtime.parts = [
            self.processes,
            self.values,
            self.tasks,
            self.actuation,
            measuring,
            self.adapter,
            self.contexts,
            self.configuration,
            self.demands,
        ]
        self._persistence: Persistence | None = None
        if state is not None:
            self._persistence = Persistence(self.runtime, self._state, state)
            self.runtime.parts.append(self._persistence)
        # The profile that ran last; empty: none yet.
        self._last = ""
        # The transition whose callback runs; empty: none.
        self._under_way = ""
        self._deactivating: asyncio.Task[None] | None = None

    async def learn(self) -> None:
        """Wait until the types of all own outputs are known: a publisher, here or at a peer, tells an unknown one.

        Missing types and the places searched for them are logged once.
        """
        name, logged = self.runtime.node.name, set[str]()
        while missing := unknown_outputs(self.resource):
            for output in missing:
                if not await self._learn(output) and output.type_name not in logged:
                    logged.add(output.type_name)
                    _log.warning(
                        "! %s waits for the type of output %s: %s [unknown-type]", name, output.name, output.problem
                    )
            if any(output.known is None for output in missing):
                await asyncio.sleep(TYPE_LOOK)

    async def _learn(self, output: Output) -> bool:
        name = self.runtime.node.name
        try:
            learnt = await fetch_type(self.runtime.node.master_uri, name, output.type_name)
        except UnreachableError as error:
            _log.debug("! %s: %s", name, error)  # the start reports an unreachable master
            return False
        if learnt is None:
            return False
        output.known = learnt.kind
        whence = printable(learnt.node), printable(learnt.topic)
        _log.info("= %s: %s is learnt from %s, which publishes %s", name, output.type_name, *whence)
        return True

    async def start(self) -> None:
        """Configure and activate the resource, once the types of all its outputs are known.

        Raises:
            PeerRefused: A node of this name runs at the core already, the core refuses a registration, or the
                callback of ``configure`` or ``activate`` raised.
            UnreachableError: The core does not answer.
            HungError: A function of the first profile or context has exceeded its time-out.
        """
        await self._refuse_duplicate()
        await self.learn()
        # Parameters are loaded before ``configure``, which opens the device before a profile sets it.
        await self.runtime.start(self._restore, self.configuration.load, self._configure)
        try:
            await self.adapter.settled()  # the function of the first profile ends before ``activate``
            if self.adapter.hung is not None:
                raise self.adapter.hung
            await self.activate()
        except RmpaError:
            await self.close()
            raise

    async def _restore(self) -> None:
        if self._persistence is not None:
            saved = self.adapter.saved = await self._persistence.restore()
            self.adapter.adaptation.pinned, self.contexts.chosen, self._last = saved.chosen, saved.context, saved.last
            self.actuation.by_hand = saved.by_hand | self.actuation.by_hand

    async def activate(self) -> None:
        """Activate an inactive resource: open the outputs, call its callback, then start the tasks.

        Raises:
            LocalProtocolError: The resource is not inactive, or a transition is under way.
            PeerRefused: The callback of ``activate`` raised; the resource stays inactive.
        """
        await self._change_state("activate")

    async def deactivate(self) -> None:
        """Deactivate an active resource: end its tasks, call its callback, then close the outputs.

        Raises:
            LocalProtocolError: The resource is not active, or a transition is under way.
        """
        await self._change_state("deactivate")

    async def close(self) -> None:
        """Finalize the resource, from any state, and close its parts and its node; does nothing the second time."""
        if self.runtime.state is _FINALIZED:
            return
        if self._deactivating is not None:
            await asyncio.wait([self._deactivating])
        if self.runtime.state is _ACTIVE:
            await self.deactivate()
        await self._change_state("finalize")
        await self.runtime.close()
        self.ended.set()

    async def _configure(self) -> None:
        try:
            await self._change_state("configure")
        except RmpaError:
            await self._change_state("finalize")
            raise

    async def _refuse_duplicate(self) -> None:
        """Refuse to start if a node of this name runs already, because registering again would shut that node down.

        Raises:
            PeerRefused: Such a node runs.
        """
        node = self.runtime.node
        reply = await call_api(node.master_uri, "lookupNode", node.name, node.name)
        if reply.code != 1:
            return
        try:
            other = await call_api(str(reply.value), "getPid", node.name, timeout=1.0)
        except RmpaError:
            return  # a registration without a running node
        text = f"a node {node.name} runs there already (process {other.value})"
        raise PeerRefused(f"the core at {node.master_uri}", text, "end it, or name this resource otherwise")

    async def _change_state(self, transition: str) -> None:
        """Make a transition of the life cycle, with the user's callback for it.

        If the callback raises, the state stays the same, except after ``finalize`` and ``deactivate``: an error must
        not prevent these.
        """
        runtime, (valid, target) = self.runtime, TRANSITIONS[transition]
        if self._under_way:
            raise LocalProtocolError(f"{transition} while {self._under_way} is under way")
        if runtime.state not in valid:
            raise LocalProtocolError(f"{runtime.state} does not lead anywhere by {transition}")
        self._under_way = transition
        if transition == "deactivate":
            await self.tasks.deactivate()
        elif transition == "activate":
            runtime.open_outputs()
        why = ""
        try:
            if (hook := self.resource.hooks.get(transition)) is not None:
                await call_hook(hook, transition)
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = f"{type(error).__name__}: {error}"
            _log.warning("! %s: %s: %s [resource-trouble]", runtime.node.name, transition, why)
        refused = bool(why) and transition in ("configure", "activate")
        self._under_way = ""
        runtime.state = runtime.state if refused else target
        if runtime.state is not _ACTIVE:
            runtime.close_outputs()
        elif not refused:
            self.tasks.activate()
        runtime.publish_text("state", runtime.state)
        self.processes.note_soon()
        if refused:
            raise PeerRefused(f"resource {self.resource.name}", f"{transition}: {why}")

    def _deactivate_soon(self, why: str) -> None:
        over = self._deactivating is None or self._deactivating.done()
        if over and self.runtime.state is _ACTIVE and not self._under_way:
            _log.error("! %s is deactivated: %s [resource-trouble]", self.runtime.node.name, why)
            self._deactivating = start_task(self.deactivate(), f"deactivate {self.resource.name}")

    def _state(self, now: float, now_ns: int) -> SavedState:
        """The state to keep over a restart; see ``Persistence``."""
        loop = self.adapter.adaptation
        self._last = loop.profile or self._last
        cooling = loop.cooling(asyncio.get_running_loop().time())
        if self.runtime.state is _FINALIZED:
            self.adapter.learnt.update()
        own = {n: p for n, p in self.resource.parameters.items() if n not in self.resource.bound}
        return SavedState(
            parameters={n: p.value for n, p in own.items() if p.value != p.default},
            chosen=loop.pinned,
            last=self._last,
            context=self.contexts.chosen,
            requirements=self.adapter.clients.save(loop.requirements, now, now_ns),
            cool_downs={
                name: SavedCoolDown(
                    until_ns=now_ns + round((one.until - now) * 1e9), cool_down=one.cool_down, why=one.why
                )
                for name, one in cooling.items()
            },
            by_hand=dict(self.actuation.by_hand),
            learnt=self.adapter.learnt.saved,
        )


def unknown_outputs(resource: Resource) -> list[Output]:
    """The outputs that the resource cannot publish yet, because their type is unknown."""
    return [output for output in resource.outputs.values() if output.known is None and not output.observed]


async def run_all(
    resources: list[Resource],
    master_uri: str,
    stop: asyncio.Event,
    ready: Callable[[], None],
    directory: Path | None = None,
) -> None:
    """Run resources until ``stop`` is set or all of them have ended.

    Args:
        resources: Resources of one module, with different names.
        master_uri: URI of the master of the module's core.
        stop: Set by the caller to end all resources; set here when a function has exceeded its time-out.
        ready: Called when all resources are active.
        directory: The folder of the resources' state; ``None``: nothing is kept over a restart.

    Raises:
        RmpaError: A resource cannot start, or a function of one has exceeded its time-out; all are closed.
    """
    running: list[ResourceNode] = []
    stopped = start_task(stop.wait(), "wait for the end")
    try:
        # Resources that wait for the type of an output start last.
        for resource in sorted(resources, key=lambda each: bool(unknown_outputs(each))):
            state = directory / f"{resource.name}.json" if directory is not None else None
            one = ResourceNode(resource, master_uri, state=state, stop=stop)
            types = start_task(one.learn(), f"types of {resource.name}", raises=(RmpaError,))
            await asyncio.wait([types, stopped], return_when=asyncio.FIRST_COMPLETED)
            if not types.done():
                await end_tasks(types)
                break
            await types
            await one.start()
            running.append(one)
        else:
            ready()
            while not stop.is_set() and (left := [one for one in running if not one.ended.is_set()]):
                ended = start_task(left[0].ended.wait(), "wait for a resource's end")
                await asyncio.wait([ended, stopped], return_when=asyncio.FIRST_COMPLETED)
                ended.cancel()
    finally:
        await end_tasks(stopped)
        for one in reversed(running):
            await one.close()
    for one in running:
        if one.adapter.hung is not None:
            raise one.adapter.hung
