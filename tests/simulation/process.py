"""An agent's process in the simulated world: an event loop on which asyncio's own futures and tasks run.

What the agent is made of is the real code, down to the sockets' callbacks; only the time, and who is called next,
come from the ``World``. A process that is killed does nothing more, wherever it was.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from tests.simulation.network import World

_T = TypeVar("_T")


class Handle:
    """A scheduled call."""

    __slots__ = ("_action", "_args", "_process")

    def __init__(self, process: Process, action: Callable[..., object], args: tuple[Any, ...]) -> None:
        self._process: Process | None = process
        self._action = action
        self._args = args

    def cancel(self) -> None:
        """Cancel the call."""
        self._process = None
        self._args = ()

    def __call__(self) -> None:
        process = self._process
        if process is not None:
            self._process = None
            process.run(self._action, *self._args)


class Process(asyncio.AbstractEventLoop):
    """The event loop of one run of one agent, as far as asyncio and the agent need it.

    Args:
        world: Clock and queue.
        name: For messages.
    """

    def __init__(self, world: World, name: str) -> None:
        self.world = world
        self.name = name
        self.dead = False
        self.readers: dict[int, Callable[[], object]] = {}
        self.writers: dict[int, Callable[[], object]] = {}
        self.on_reader: dict[int, Callable[[], None]] = {}
        """By descriptor: makes the socket check whether it is readable or writable."""
        self.on_writer: dict[int, Callable[[], None]] = {}
        self.failures: list[str] = []
        """Exceptions that were never retrieved, which asyncio would only log."""

    def run(self, action: Callable[..., _T], *args: Any) -> _T | None:
        """Call ``callback`` in this process, unless it is dead."""
        if self.dead:
            return None
        before = asyncio._get_running_loop()
        asyncio._set_running_loop(self)
        try:
            return action(*args)
        finally:
            asyncio._set_running_loop(before)

    def kill(self) -> None:
        """Cancel all that is scheduled."""
        self.dead = True
        self.readers.clear()
        self.writers.clear()

    # --- the methods of an event loop that asyncio and the agent use -----------------------------------------

    def time(self) -> float:
        return self.world.now

    def call_soon(self, callback: Callable[..., object], *args: Any, context: object = None) -> Handle:  # type: ignore[override]
        return self.call_at(self.world.now, callback, *args)

    def call_later(self, delay: float, callback: Callable[..., object], *args: Any, context: object = None) -> Handle:  # type: ignore[override]
        return self.call_at(self.world.now + delay, callback, *args)

    def call_at(self, when: float, callback: Callable[..., object], *args: Any, context: object = None) -> Handle:  # type: ignore[override]
        handle = Handle(self, callback, args)
        self.world.at(when, handle)
        return handle

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task(self, coro: Coroutine[Any, Any, _T], *, name: str | None = None, **_: Any) -> asyncio.Task[_T]:  # type: ignore[override]
        return asyncio.Task(coro, loop=self, name=name)

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        if not self.dead:
            self.failures.append(f"{self.name}: {context.get('message')}: {context.get('exception')!r}")

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return not self.dead

    def is_closed(self) -> bool:
        return self.dead

    def add_reader(self, fd: int, callback: Callable[..., object], *args: Any) -> None:  # type: ignore[override]
        self.readers[fd] = callback
        self.on_reader[fd]()

    def remove_reader(self, fd: int) -> bool:  # type: ignore[override]
        return self.readers.pop(fd, None) is not None

    def add_writer(self, fd: int, callback: Callable[..., object], *args: Any) -> None:  # type: ignore[override]
        self.writers[fd] = callback
        self.on_writer[fd]()

    def remove_writer(self, fd: int) -> bool:  # type: ignore[override]
        return self.writers.pop(fd, None) is not None
