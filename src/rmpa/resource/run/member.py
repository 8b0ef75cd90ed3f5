"""A whole resource: its node, its tasks, its loop, and its life cycle."""

from __future__ import annotations

import asyncio
import inspect
import logging
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource.decide.lifecycle import LifeCycle, LifecycleState, Transition
from rmpa.resource.run.adapter import Adapter
from rmpa.resource.run.contexts import Contexts
from rmpa.resource.run.demands import Demands
from rmpa.resource.run.persistence import Persistence
from rmpa.resource.run.reconfigure import Reconfigure
from rmpa.resource.run.registry_writer import FILE, RegistryWriter
from rmpa.resource.run.runtime import Runtime, RuntimePart
from rmpa.resource.run.store import ResourceStore
from rmpa.resource.run.tasks import Tasks
from rmpa.resource.run.types import learn_outputs
from rmpa.ros.http.client import call_api
from rmpa.ros.node.node import Node
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

    from rmpa.resource.decide.adaptation import AdaptationSettings
    from rmpa.resource.declare.resource import Resource
    from rmpa.resource.run.tasks import TaskProblem

_log = logging.getLogger(__name__)


class Member:
    """Runs one resource on the core of its module.

    Args:
        resource: Declared completely.
        master_uri: The core's.
        window: Seconds of one quality window.
        settings: How patient its loop is.
        store: Where it remembers what is to survive a restart; without one it remembers nothing.

    Raises:
        ConfigError: It declares no profile: there would be nothing to decide.
    """

    def __init__(
        self,
        resource: Resource,
        master_uri: str,
        *,
        window: float | None = None,
        settings: AdaptationSettings | None = None,
        store: ResourceStore | None = None,
    ) -> None:
        if not resource.profiles:
            remedy = "declare one: @NAME.profile(offers={…})"
            raise ConfigError(f"resource {resource.name}", "it has no System Profile", remedy)
        self.resource = resource
        self.life = LifeCycle()
        self.ended = asyncio.Event()
        """Set when the resource is finalized, by whomever."""
        node = Node(resource.name, master_uri=master_uri, on_shutdown=lambda _reason: self.ended.set())
        self.runtime = Runtime(resource, node)
        self.runtime.close_outputs()
        self.tasks = Tasks(self.runtime, on_problem=self._problem, on_deactivate=self._deactivate_soon)
        self.adapter = Adapter(
            self.runtime,
            self.tasks,
            window=window if window is not None else resource.window,
            settings=settings if settings is not None else resource.settings,
        )
        self.adapter.troubles = self._troubles
        self.contexts = Contexts(self.runtime, self.tasks, self.adapter)
        self.configuration = Reconfigure(self.runtime, self.tasks, self.adapter, self.contexts)
        self.demands = Demands(self.runtime)
        self.adapter.on_window.append(self.demands.window)
        self.adapter.on_window.append(lambda _level, _message, _measured: self.tasks.judge())
        first = [self.configuration.before, _Configuring(self._configure), self.tasks]
        parts = [*first, self.adapter, self.contexts, self.configuration, self.demands]
        self.memory = Persistence(self.runtime, self.adapter, self.contexts, store) if store is not None else None
        self.runtime.parts += [*parts, self.memory] if self.memory is not None else parts
        self.known: RegistryWriter | None = None
        """Where other resources are written down, if that is here."""
        self._deactivating: asyncio.Task[None] | None = None

    def add(self, part: RuntimePart) -> None:
        """Let a further part hear of everything; before ``start()``."""
        self.runtime.parts.append(part)

    def keep_others(self, store: ResourceStore) -> None:
        """Write down which other resources there are; before ``start()``, for one resource of a process."""
        self.known = RegistryWriter(self.runtime, self.demands, store)
        self.add(self.known)

    async def learn(self) -> None:
        """Wait until the types of all outputs are known; those that this machine does not know, publishers tell."""
        await learn_outputs(self.resource, self.runtime.node.master_uri, self.runtime.node.name)

    async def start(self) -> None:
        """Configure and activate it, once the types of all its outputs are known.

        Raises:
            PeerRefused: A node of its name is on this core already, or one of its hooks raised.
            UnreachableError: The core does not answer.
        """
        await self._refuse_twin()
        await self.learn()
        if self.memory is not None:
            await self.memory.recall()
        try:
            await self.runtime.start()
        except BaseException:
            if self.memory is not None:
                await self.memory.close()
            raise
        await self.adapter.settled()  # the first profile's function and the hooks run one behind the other
        try:
            await self._turn(Transition.ACTIVATE)
        except RmpaError:
            await self.close()
            raise

    async def activate(self) -> None:
        """Let it work again.

        Raises:
            PeerRefused: Its hook raised.
        """
        await self._turn(Transition.ACTIVATE)

    async def deactivate(self) -> None:
        """Let it rest: no task runs."""
        await self._turn(Transition.DEACTIVATE)

    async def close(self) -> None:
        """Finalize it, whatever its state."""
        if self.life.state is LifecycleState.FINALIZED:
            return
        if self._deactivating is not None:
            await asyncio.wait([self._deactivating])
        if self.life.state is LifecycleState.ACTIVE:
            await self._turn(Transition.DEACTIVATE)
        await self._turn(Transition.FINALIZE)
        await self.runtime.close()
        self.ended.set()

    # --- inside -------------------------------------------------------------------------------------------------

    async def _configure(self) -> None:
        try:
            await self._turn(Transition.CONFIGURE)
        except RmpaError:
            await self._turn(Transition.FINALIZE)
            raise

    async def _refuse_twin(self) -> None:
        """A second node of one name would end the first one."""
        node = self.runtime.node
        reply = await call_api(node.master_uri, "lookupNode", node.name, node.name)
        if reply.code != 1:
            return
        try:
            other = await call_api(str(reply.value), "getPid", node.name, timeout=1.0)
        except RmpaError:
            return  # a leftover of one that is dead
        text = f"a node {node.name} runs there already (process {other.value})"
        raise PeerRefused(f"the core at {node.master_uri}", text, "end it, or name this resource otherwise")

    async def _turn(self, transition: Transition) -> None:
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
        state = self.life.failed(why) if why else self.life.succeeded()
        if state is not LifecycleState.ACTIVE:
            self.runtime.close_outputs()
        if transition is Transition.ACTIVATE and not why:
            self.tasks.activate()
        await self.runtime.say("state", state.value)
        if why and transition in (Transition.CONFIGURE, Transition.ACTIVATE):
            raise PeerRefused(f"resource {self.resource.name}", f"{transition}: {why}")

    def _problem(self, problem: TaskProblem) -> None:
        _log.warning("! %s: %s", self.runtime.node.name, problem)

    def _deactivate_soon(self, why: str) -> None:
        over = self._deactivating is None or self._deactivating.done()
        if over and self.life.state is LifecycleState.ACTIVE and self.life.under_way is None:
            _log.error("! %s is deactivated: %s", self.runtime.node.name, why)
            self._deactivating = asyncio.get_running_loop().create_task(self.deactivate(), name="deactivate")

    def _troubles(self) -> tuple[list[str], list[str]]:
        """What is wrong beside the quality: inputs that nobody publishes, and tasks that do not work."""
        missing = [
            f"nobody publishes {name}"
            for name, item in self.resource.inputs.items()
            if item.required and not self.runtime.publishers_of(item)
        ]
        tasks = self.tasks.troubles
        absent, short = self.demands.troubles()
        missing += absent
        tasks += short
        tasks += [f"rule over {problem}" for problem in self.contexts.problems]
        if self.memory is not None and self.memory.problem:
            tasks.append(self.memory.problem)
        if self.known is not None and self.known.problem:
            tasks.append(self.known.problem)
        if self.life.state is not LifecycleState.ACTIVE:
            tasks.append(f"it is {self.life.state}")
        return missing, tasks


class _Configuring(RuntimePart):
    """Configures the resource when its parameters have been taken up, before any profile is applied.

    What opens the device is done before what sets it.
    """

    def __init__(self, configure: Callable[[], Awaitable[None]]) -> None:
        self._configure = configure

    async def start(self) -> None:
        """Configure; what it raises ends the start."""
        await self._configure()


async def run_all(
    resources: list[Resource],
    master_uri: str,
    stop: asyncio.Event,
    ready: Callable[[], None],
    stores: Path | None = None,
) -> None:
    """Run resources until ``stop`` is set or all of them have ended.

    Args:
        resources: Of one module, of different names.
        master_uri: Its core's.
        stop: Set by the caller.
        ready: Called when all are active.
        stores: The folder of their stores; ``None``: nothing is remembered over a restart.

    Raises:
        RmpaError: One of them cannot start; those that have are closed.
    """
    members: list[Member] = []
    stopped = asyncio.create_task(_stopped(stop))
    try:
        # One that waits for the type of an output holds up no other.
        for resource in sorted(resources, key=lambda each: any(o.kind.known is None for o in each.outputs.values())):
            store = ResourceStore(stores / f"{resource.name}.sqlite") if stores is not None else None
            member = Member(resource, master_uri, store=store)
            if stores is not None and not members:
                member.keep_others(ResourceStore(stores / FILE))
            if not await _started(member, stopped):
                return
            members.append(member)
        ready()
        ended = asyncio.create_task(_all_ended(members))
        await asyncio.wait([ended, stopped], return_when=asyncio.FIRST_COMPLETED)
        ended.cancel()
        await asyncio.gather(ended, return_exceptions=True)
    finally:
        stopped.cancel()
        await asyncio.gather(stopped, return_exceptions=True)
        for member in reversed(members):
            await member.close()


async def _started(member: Member, stopped: asyncio.Task[None]) -> bool:
    """Start a resource; ``False``: it still waited for a type when it was to stop.

    Raises:
        RmpaError: It cannot start.
    """
    types = asyncio.create_task(member.learn(), name=f"types of {member.resource.name}")
    await asyncio.wait([types, stopped], return_when=asyncio.FIRST_COMPLETED)
    if not types.done():
        types.cancel()
        await asyncio.gather(types, return_exceptions=True)
        return False
    await types
    await member.start()
    return True


async def _all_ended(members: list[Member]) -> None:
    for member in members:
        await member.ended.wait()


async def _stopped(stop: asyncio.Event) -> None:
    await stop.wait()
