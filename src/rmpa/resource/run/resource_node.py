"""A running resource: its node, its parts and its life cycle."""

from __future__ import annotations

import asyncio
import inspect
import logging
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.resource.decide.reports import LifeCycle, LifecycleState, Transition
from rmpa.resource.run.adapter import Adapter
from rmpa.resource.run.client import Demands
from rmpa.resource.run.contexts import Contexts, Persistence
from rmpa.resource.run.reconfigure import Reconfigure
from rmpa.resource.run.runtime import Runtime, RuntimePart
from rmpa.resource.run.tasks import Tasks
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.fetch_type import fetch_type
from rmpa.ros.node.node import Node
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.accept import in_thread

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from pathlib import Path

    from rmpa.resource.declare.parameters import AdaptationSettings, Output
    from rmpa.resource.declare.resource import Resource
    from rmpa.resource.run.tasks import TaskProblem


# Learns the types of outputs that are unknown on this machine from a publisher, in this module or at a peer.


_log = logging.getLogger(__name__)


async def learn_outputs(resource: Resource, master_uri: str, caller_id: str) -> None:
    """Wait until the type of each output is known; missing types and the places searched for them are logged once.

    Args:
        resource: The resource, completely declared; the function sets the types of its outputs.
        master_uri: URI of the master whose publishers are queried.
        caller_id: Name of the resource's node, which need not be registered yet.
    """
    logged: set[str] = set()
    while missing := [output for output in resource.outputs.values() if output.kind.known is None]:
        for output in missing:
            if await _learn(output, master_uri, caller_id) or output.kind.name in logged:
                continue
            logged.add(output.kind.name)
            _log.warning("! %s waits for the type of output %s: %s", caller_id, output.name, output.kind.problem)
        if any(output.kind.known is None for output in missing):
            await asyncio.sleep(limits.TYPE_LOOK)


async def _learn(output: Output, master_uri: str, caller_id: str) -> bool:
    try:
        learnt = await fetch_type(master_uri, caller_id, output.kind.name)
    except UnreachableError as error:
        _log.debug("! %s: %s", caller_id, error)  # the resource's start reports an unreachable master
        return False
    if learnt is not None:
        output.kind.known = learnt.kind
        whence = printable(learnt.node), printable(learnt.topic)
        _log.info("= %s: %s is learnt from %s, which publishes %s", caller_id, output.kind.name, *whence)
    return learnt is not None


class ResourceNode:
    """Runs one resource on the core of its module.

    Args:
        resource: The resource, completely declared.
        master_uri: URI of the core's master.
        window: Length of a quality window in seconds; ``None``: as declared.
        settings: Settings of the control loop; ``None``: as declared.
        state: The file that keeps the resource's state over a restart; ``None``: nothing is kept.
        on_hung: Called when a function of a profile or context has exceeded its time-out: the resource has to end.
        observers: Further parts, started last.

    Raises:
        ConfigError: The resource declares no profile, so there is nothing to decide.
    """

    def __init__(
        self,
        resource: Resource,
        master_uri: str,
        *,
        window: float | None = None,
        settings: AdaptationSettings | None = None,
        state: Path | None = None,
        on_hung: Callable[[], None] = lambda: None,
        observers: Sequence[RuntimePart] = (),
    ) -> None:
        if not resource.profiles:
            remedy = "declare one: @NAME.profile(offers={…})"
            raise ConfigError(f"resource {resource.name}", "it has no System Profile", remedy)
        self.resource = resource
        self.life = LifeCycle()
        self.ended = asyncio.Event()
        """Set when the resource is finalized, or when its node is shut down from outside."""
        node = Node(resource.name, master_uri=master_uri, on_shutdown=lambda _reason: self.ended.set())
        self.runtime = Runtime(resource, node)
        self.runtime.close_outputs()
        self.tasks = Tasks(self.runtime, on_problem=self._task_problem, on_deactivate=self._deactivate_soon)
        self.adapter = Adapter(
            self.runtime,
            self.tasks,
            window=window if window is not None else resource.window,
            settings=settings if settings is not None else resource.settings,
            problems=self.problems,
            on_hung=on_hung,
        )
        self.contexts = Contexts(self.runtime, self.tasks, self.adapter)
        self.configuration = Reconfigure(self.runtime, self.tasks, self.adapter, self.contexts)
        self.demands = Demands(self.runtime)
        self._persistence = Persistence(self.runtime, self.adapter, self.contexts, state) if state else None
        # Parameters are loaded before ``configure``; ``configure`` opens the device before a profile sets it.
        first = [_StartStep(self.configuration.load), _StartStep(self._configure), self.tasks]
        parts = [*first, self.adapter, self.contexts, self.configuration, self.demands]
        self.parts: list[RuntimePart] = [*parts, *filter(None, (self._persistence,)), *observers]
        """In the order of their start."""
        self._deactivating: asyncio.Task[None] | None = None

    async def learn(self) -> None:
        """Wait until the types of all outputs are known."""
        await learn_outputs(self.resource, self.runtime.node.master_uri, self.runtime.node.name)

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
        if self._persistence is not None:
            saved = await self._persistence.restore()
            self.adapter.restore(saved)
            self.contexts.preset(saved.context)
        try:
            await self.runtime.start(self.parts)
        except BaseException:
            if self._persistence is not None:
                await self._persistence.close()
            raise
        try:
            await self.adapter.settled()  # the function of the first profile ends before ``activate``
            if self.adapter.hung is not None:
                raise self.adapter.hung
            await self._change_state(Transition.ACTIVATE)
        except RmpaError:
            await self.close()
            raise

    async def activate(self) -> None:
        """Activate an inactive resource: open the outputs, call its callback, then start the tasks.

        Raises:
            LocalProtocolError: The resource is not inactive, or a transition is under way.
            PeerRefused: The callback of ``activate`` raised; the resource stays inactive.
        """
        await self._change_state(Transition.ACTIVATE)

    async def deactivate(self) -> None:
        """Deactivate an active resource: end its tasks, call its callback, then close the outputs.

        Raises:
            LocalProtocolError: The resource is not active, or a transition is under way.
        """
        await self._change_state(Transition.DEACTIVATE)

    async def close(self) -> None:
        """Finalize the resource, from any state, and close its parts and its node; does nothing the second time."""
        if self.life.state is LifecycleState.FINALIZED:
            return
        if self._deactivating is not None:
            await asyncio.wait([self._deactivating])
        if self.life.state is LifecycleState.ACTIVE:
            await self._change_state(Transition.DEACTIVATE)
        await self._change_state(Transition.FINALIZE)
        await self.runtime.close()
        self.ended.set()

    def problems(self) -> tuple[list[str], list[str]]:
        """Problems apart from the quality, as texts: first what is missing, second what does not work."""
        missing = [
            f"no node publishes {name}"
            for name, item in self.resource.inputs.items()
            if item.required and not self.runtime.publishers_of(item)
        ]
        absent, short = self.demands.problems()
        broken = [*self.tasks.problems, *short, *(f"rule over {problem}" for problem in self.contexts.problems)]
        if self._persistence is not None and self._persistence.problem:
            broken.append(self._persistence.problem)
        if self.life.state is not LifecycleState.ACTIVE:
            broken.append(f"it is {self.life.state}")
        return [*missing, *absent], broken

    # --- inside -------------------------------------------------------------------------------------------------

    async def _configure(self) -> None:
        try:
            await self._change_state(Transition.CONFIGURE)
        except RmpaError:
            await self._change_state(Transition.FINALIZE)
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

    async def _change_state(self, transition: Transition) -> None:
        self.life.begin(transition)
        if transition is Transition.DEACTIVATE:
            await self.tasks.deactivate()
        elif transition is Transition.ACTIVATE:
            self.runtime.open_outputs()
        why = ""
        hook = self.resource.hooks.get(transition.value)
        try:
            if inspect.iscoroutinefunction(hook):
                await hook()
            elif hook is not None:
                outcome = await in_thread(hook, transition.value)
                if outcome is not None:
                    await outcome
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            why = f"{type(error).__name__}: {error}"
            _log.warning("! %s: %s: %s", self.runtime.node.name, transition, why)
        state = self.life.failed() if why else self.life.succeeded()
        if state is not LifecycleState.ACTIVE:
            self.runtime.close_outputs()
        if transition is Transition.ACTIVATE and not why:
            self.tasks.activate()
        await self.runtime.advertise_text("state", state.value)
        if why and transition in (Transition.CONFIGURE, Transition.ACTIVATE):
            raise PeerRefused(f"resource {self.resource.name}", f"{transition}: {why}")

    def _task_problem(self, problem: TaskProblem) -> None:
        _log.warning("! %s: %s", self.runtime.node.name, problem)

    def _deactivate_soon(self, why: str) -> None:
        over = self._deactivating is None or self._deactivating.done()
        if over and self.life.state is LifecycleState.ACTIVE and self.life.under_way is None:
            _log.error("! %s is deactivated: %s", self.runtime.node.name, why)
            self._deactivating = asyncio.get_running_loop().create_task(self.deactivate(), name="deactivate")


class _StartStep(RuntimePart):
    """A part that calls one coroutine function when it starts; an error of that function ends the start."""

    def __init__(self, step: Callable[[], Awaitable[None]]) -> None:
        self._step = step

    async def start(self) -> None:
        await self._step()


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
        stop: Set by the caller to end all resources.
        ready: Called when all resources are active.
        directory: The folder of the resources' state; ``None``: nothing is kept over a restart.

    Raises:
        RmpaError: A resource cannot start, or a function of one has exceeded its time-out; all are closed.
    """
    running: list[ResourceNode] = []
    stopped = asyncio.create_task(_wait(stop))
    try:
        # Resources that wait for the type of an output start last.
        for resource in sorted(resources, key=lambda each: any(o.kind.known is None for o in each.outputs.values())):
            state = directory / f"{resource.name}.json" if directory is not None else None
            one = ResourceNode(resource, master_uri, state=state, on_hung=stop.set)
            if not await _start(one, stopped):
                break
            running.append(one)
        else:
            ready()
            ended = asyncio.create_task(_all_ended(running))
            await asyncio.wait([ended, stopped], return_when=asyncio.FIRST_COMPLETED)
            ended.cancel()
            await asyncio.gather(ended, return_exceptions=True)
    finally:
        stopped.cancel()
        await asyncio.gather(stopped, return_exceptions=True)
        for one in reversed(running):
            await one.close()
    for one in running:
        if one.adapter.hung is not None:
            raise one.adapter.hung


async def _start(node: ResourceNode, stopped: asyncio.Task[None]) -> bool:
    """Start a resource; false if it still waited for a type when ``stopped`` ended.

    Raises:
        RmpaError: The resource cannot start.
    """
    types = asyncio.create_task(node.learn(), name=f"types of {node.resource.name}")
    await asyncio.wait([types, stopped], return_when=asyncio.FIRST_COMPLETED)
    if not types.done():
        types.cancel()
        await asyncio.gather(types, return_exceptions=True)
        return False
    await types
    await node.start()
    return True


async def _all_ended(nodes: list[ResourceNode]) -> None:
    for node in nodes:
        await node.ended.wait()


async def _wait(event: asyncio.Event) -> None:
    await event.wait()
