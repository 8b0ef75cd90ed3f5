"""``connect``: a node for scripts, without asyncio; as near to rospy as that is possible.

::

    with rmpa.connect("talker") as node:
        chatter = node.advertise("/chatter", "std_msgs/String")
        for count in node.rate(10):
            chatter.publish(data=f"hello {count}")

Its methods are those of ``rmpa.Node``, with the same names, and wait for the result. Callbacks get the message itself
and run in threads, so that they may wait too: each subscription has a thread, each timer, and each call of a service.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import signal
import sys
import threading
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Concatenate, Final, ParamSpec, Self, TypeVar

from rmpa.config.limits import SERVICE_TIMEOUT
from rmpa.core.errors import RmpaError
from rmpa.core.timers import positive
from rmpa.ros import limits
from rmpa.ros.node.node import Node, check_plain
from rmpa.runtime.tasks import end_tasks

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
    from types import FrameType, TracebackType

    from rmpa.ros.node.endpoints import ParamCallback, Publisher, Service, Subscriber
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)

_T = TypeVar("_T")
_P = ParamSpec("_P")

# Messages that wait for a callback; above it the oldest is dropped.
_QUEUE: Final = 100
# Seconds for a node to unregister, and then for its loop to end; after them the end of the program ends them.
_CLOSE_WITHIN: Final = 10.0
_NO_DEFAULT: Final = object()


def connect(
    name: str, *, master_uri: str = "", anonymous: bool = False, argv: Sequence[str] | None = None
) -> SyncNode:
    """Make a node for a script; use the result in a ``with``, which Ctrl-C and SIGTERM end.

    Args:
        name: The node's name, resolved in the namespace.
        master_uri: Replaces ROS_MASTER_URI.
        anonymous: Whether the name is made unique.
        argv: Arguments that replace names and set private parameters (``chatter:=/other __name:=me _gain:=2``), as
            roslaunch gives them; ``None``: those of the program.
    """
    return SyncNode(name, master_uri=master_uri, anonymous=anonymous, argv=sys.argv[1:] if argv is None else argv)


class SyncPublisher:
    """Publishes one topic of a ``SyncNode``; made by ``SyncNode.advertise``."""

    def __init__(self, publisher: Publisher, node: SyncNode) -> None:
        self._publisher = publisher
        self._node = node

    @property
    def topic(self) -> str:
        """The global name."""
        return self._publisher.topic

    @property
    def subscribers(self) -> int:
        """Number of connected subscribers."""
        return self._publisher.subscribers

    def publish(self, message: object = None, /, **fields: object) -> int:
        """Publish a message, as ``rmpa.Publisher.publish``: a message, plain values, or fields by name.

        Returns:
            The number of older messages dropped for slow subscribers.

        Raises:
            MessageError: The message does not fit the type, whether there is a subscriber or not.
            RmpaError: The publisher is closed, or the ``with`` has ended.
        """

        async def publish() -> int:
            return self._publisher.publish(message, **fields)

        return self._node._wait_for(publish())  # noqa: SLF001 - of this file

    def close(self) -> None:
        """Send the queued messages, and publish the topic no more; may be called twice."""
        self._node._end_of(self._publisher)  # noqa: SLF001 - of this file

    def wait_for_subscriber(self, timeout: float | None = None) -> bool:
        """Wait until there is a subscriber; false if there is none in time.

        Raises:
            RmpaError: The publisher or its node is closed.
        """

        async def wait() -> bool:
            try:
                async with asyncio.timeout(timeout):
                    await self._publisher.wait_for_subscriber()
            except TimeoutError:
                return False
            return True

        return self._node._wait_for(wait())  # noqa: SLF001 - of this file


def _waiting(
    method: Callable[Concatenate[Node, _P], Coroutine[Any, Any, _T]],
) -> Callable[Concatenate[SyncNode, _P], _T]:
    """A method of ``Node`` with the same arguments, which waits for the result."""

    @functools.wraps(method)
    def call(node: SyncNode, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return node._wait_for(method(node._open_node, *args, **kwargs))  # noqa: SLF001 - of this file

    return call


class SyncNode:
    """A node for scripts; made by ``connect``.

    A ``with`` registers it, and unregisters it at its end. In the main thread Ctrl-C and SIGTERM end the ``with``:
    KeyboardInterrupt interrupts what runs in it, and the program goes on behind it. A second signal, while it ends,
    does what it did before the ``with``: it ends the program. When the master shuts the node down (``rosnode kill``),
    ``rate`` and ``spin`` end. A process that is forked in a ``with`` makes a node of its own.

    Args:
        name: The node's name, resolved in the namespace.
        master_uri: Replaces ROS_MASTER_URI.
        anonymous: Whether the name is made unique.
        argv: Arguments that replace names and set private parameters.
    """

    def __init__(self, name: str, *, master_uri: str, anonymous: bool, argv: Sequence[str]) -> None:
        self._name = name
        self._make = functools.partial(Node, name, master_uri=master_uri, anonymous=anonymous, argv=argv)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._node: Node | None = None
        self._stopped = threading.Event()
        self._pid = 0
        self._closing = False
        self._close_lock = threading.Lock()
        self._restore: list[tuple[signal.Signals, Any]] = []

    def __enter__(self) -> Self:
        """Register at the master.

        Raises:
            UnreachableError: The master does not answer.
            ConfigError: A ROS variable cannot be used.
            RmpaError: The node was opened before.
        """
        if self._pid:
            raise RmpaError(f"{self._name} was opened before: make another with rmpa.connect(...)")
        self._pid = os.getpid()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=f"rmpa {self._name}", daemon=True)
        self._thread.start()
        try:
            self._node = self._wait_for(self._open())
        except BaseException:
            self._end()
            raise
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._restore.append((number, signal.signal(number, self._interrupt)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        """Unregister and close; KeyboardInterrupt ends here."""
        self.close()
        return isinstance(error, KeyboardInterrupt)

    def close(self) -> None:
        """Unregister everything and close; may be called twice."""
        self._closing = True
        with self._close_lock:
            if self._loop is not None and self._node is not None and self._pid == os.getpid():
                try:
                    self._wait_for(self._node.close(), _CLOSE_WITHIN)
                except TimeoutError:
                    _log.warning("! %s has not unregistered in %g s [ending-slowly]", self._node.name, _CLOSE_WITHIN)
                self._end()
        self._restore_signals()

    @property
    def name(self) -> str:
        """The global name."""
        return self._open_node.name

    @property
    def logger(self) -> logging.Logger:
        """The node's log, which goes to ``/rosout``; see ``rmpa.Node.logger``."""

        async def logger() -> logging.Logger:
            return self._open_node.logger

        return self._wait_for(logger())

    def advertise(
        self,
        topic: str,
        kind: str | MessageType,
        *,
        latch: bool = False,
        queue_messages: int = limits.SUBSCRIBER_QUEUE_MESSAGES,
    ) -> SyncPublisher:
        """Publish a topic; see ``rmpa.Node.advertise``.

        Args:
            topic: Resolved in the namespace; ``~name`` is the node's own.
            kind: The type, ``package/Name``, or one that is made.
            latch: Whether each new subscriber gets the last message.
            queue_messages: Messages queued for one slow subscriber; above it the oldest is dropped.
        """
        node = self._open_node
        made = self._wait_for(node.advertise(topic, kind, latch=latch, queue_messages=queue_messages))
        if made.kind is not None:
            made.kind.serialize(made.make())  # makes its code, so that the first message does not wait for that
        return SyncPublisher(made, self)

    def subscribe(
        self, topic: str, kind: str | None, callback: Callable[[Any], object], *, queue_messages: int = _QUEUE
    ) -> Callable[[], None]:
        """Subscribe to a topic; see ``rmpa.Node.subscribe``.

        Args:
            topic: Resolved in the namespace.
            kind: The type, ``package/Name``; ``None`` accepts any.
            callback: Called with each message, in a thread, one after the other; its exceptions are logged.
            queue_messages: Messages that wait for the callback; above it the oldest is dropped.

        Returns:
            A function that ends it.
        """
        check_plain(callback, f"the callback for {topic}")
        made = self._wait_for(self._open_node.subscribe(topic, kind, queue_messages=queue_messages))
        self._for_each(aiter(made), lambda received: callback(received.message), f"callback for {topic}")
        return lambda: self._end_of(made)

    def wait_for_message(self, topic: str, kind: str | None = None, timeout: float | None = None) -> Any:
        """The next message of a topic; see ``rmpa.Node.wait_for_message``.

        Raises:
            UnreachableError: There was none in time.
        """
        return self._wait_for(self._open_node.wait_for_message(topic, kind, timeout)).message

    def advertise_service(
        self, name: str, kind: str, handler: Callable[[Any], Any], *, timeout: float = SERVICE_TIMEOUT
    ) -> Callable[[], None]:
        """Serve a service; see ``rmpa.Node.advertise_service``.

        Args:
            name: Resolved in the namespace.
            kind: The type, ``package/Name``.
            handler: Called with each request, in a thread; returns the response as an object or plain values. An
                exception becomes the client's error.
            timeout: Seconds for a call before the client gets an error.

        Returns:
            A function that ends it.
        """
        check_plain(handler, f"the handler of {name}")

        async def handle(request: Any) -> Any:
            future: Future[Any] = Future()

            def run() -> None:
                future.set_running_or_notify_cancel()
                try:
                    future.set_result(handler(request))
                except BaseException as error:  # noqa: BLE001 - it is the client's answer; the loop takes no sys.exit()
                    passes = isinstance(error, Exception) and not isinstance(error, StopIteration)
                    future.set_exception(error if passes else RuntimeError(repr(error)))

            threading.Thread(target=run, name=f"call of {name}", daemon=True).start()
            return await asyncio.wrap_future(future)

        made = self._wait_for(self._open_node.advertise_service(name, kind, handle, timeout=timeout))
        return lambda: self._end_of(made)

    get_published_topics = _waiting(Node.get_published_topics)
    wait_for_service = _waiting(Node.wait_for_service)
    call_service = _waiting(Node.call_service)
    set_param = _waiting(Node.set_param)
    has_param = _waiting(Node.has_param)
    delete_param = _waiting(Node.delete_param)

    def get_param(self, key: str, default: Any = _NO_DEFAULT) -> Any:
        """A parameter's value, or ``default`` where one is given and the parameter does not exist."""
        given = {} if default is _NO_DEFAULT else {"default": default}
        return self._wait_for(self._open_node.get_param(key, **given))

    def follow_param(self, key: str, callback: ParamCallback) -> XmlRpcValue:
        """Call ``callback(key, value)`` in a thread with each change; return the present value, ``{}`` for none.

        While the callback is slow, the last 100 changes wait for it.
        """
        check_plain(callback, f"the callback for parameter {key}")
        changes: asyncio.Queue[tuple[str, XmlRpcValue]] = asyncio.Queue(_QUEUE)

        def change(key: str, value: XmlRpcValue) -> None:
            if changes.full():
                changes.get_nowait()
            changes.put_nowait((key, value))

        async def each() -> AsyncIterator[tuple[str, XmlRpcValue]]:
            while True:
                yield await changes.get()

        node = self._open_node
        value = self._wait_for(node.follow_param(key, change))
        self._for_each(each(), lambda change: callback(*change), f"callback for parameter {key}")
        return value

    def rate(self, hz: float) -> Iterator[int]:
        """The numbers 0, 1, 2 … at a rate, until the node is closed; see ``rmpa.Node.rate``."""
        ticks = self._open_node.rate(hz)

        def tick() -> int | None:
            try:
                return self._wait_for(_next(ticks))
            except RmpaError:
                if self.stopped:
                    return None
                raise

        return iter(tick, None)

    def timer(self, period: float, callback: Callable[[], object]) -> Callable[[], None]:
        """Call a function every ``period`` seconds, in a thread, one call at a time; see ``rmpa.Node.timer``.

        Returns:
            A function that ends it.
        """
        check_plain(callback, "a timer's callback")
        ended = threading.Event()

        def tick(count: int) -> None:
            if count and not ended.is_set():
                callback()

        ticks = self._open_node.rate(1 / positive(period, "a timer's period"))
        self._for_each(ticks, tick, f"timer of {period:g} s", ended)
        return ended.set

    def sleep(self, seconds: float) -> bool:
        """Sleep; false if the node is closed meanwhile."""
        self._check_process()
        return not self._stopped.wait(seconds)

    def spin(self) -> None:
        """Wait until the node is closed: by Ctrl-C, SIGTERM or the master."""
        self._check_process()
        self._stopped.wait()

    @property
    def stopped(self) -> bool:
        """Whether the node is closed."""
        return self._stopped.is_set()

    @property
    def _open_node(self) -> Node:
        if self._node is None:
            raise RmpaError(f"{self._name} is not open: write `with rmpa.connect(...) as node:`")
        return self._node

    async def _open(self) -> Node:
        return await self._make(on_shutdown=lambda _reason: self._stopped.set()).__aenter__()

    def _check_process(self) -> None:
        if self._pid and self._pid != os.getpid():  # the loop's thread is not in a forked process
            raise RmpaError(f"{self._name} belongs to process {self._pid}: a forked process makes a node of its own")

    def _running(self) -> asyncio.AbstractEventLoop:
        self._check_process()
        if self._loop is None:
            raise RmpaError(f"{self._name} is closed")
        return self._loop

    def _wait_for(self, coroutine: Coroutine[Any, Any, _T], /, within: float | None = None) -> _T:
        """Run a coroutine in the event loop, and wait for its result.

        Raises:
            RmpaError: The node is closed, or is another process's.
            TimeoutError: It is not there in time.
        """
        try:
            future: Future[_T] = asyncio.run_coroutine_threadsafe(coroutine, self._running())
        except BaseException:
            coroutine.close()
            raise
        try:
            return future.result(within)
        except CancelledError:
            raise RmpaError(f"{self._name} is closed") from None
        except (RmpaError, ValueError) as error:  # what happened in the loop is no help to a script's author
            raise error.with_traceback(None) from None
        except BaseException:
            future.cancel()
            raise

    def _end_of(self, made: Publisher | Subscriber | Service) -> None:
        try:
            self._wait_for(made.close())
        except RmpaError:
            if not self.stopped:  # else it has ended with the node
                raise

    def _for_each(
        self,
        items: AsyncIterator[_T],
        callback: Callable[[_T], object],
        what: str,
        ended: threading.Event | None = None,
    ) -> None:
        """Call a function of the script with each item, in a thread, until the items or the node end."""

        def run() -> None:
            with suppress(RmpaError, RuntimeError):  # the node, or its loop, is closed
                while not (ended and ended.is_set()) and (item := self._wait_for(_next(items))) is not None:
                    try:
                        callback(item)
                    except BaseException:  # noqa: BLE001 - the top of the user's code; sys.exit() ends no other thread
                        _log.exception("! the %s failed", what)

        threading.Thread(target=run, name=what, daemon=True).start()

    def _end(self) -> None:
        """End the loop and its thread; calls that still wait get an error."""
        self._stopped.set()
        loop, self._loop = self._loop, None
        if loop is None or self._thread is None:
            return

        async def cancel() -> None:
            await end_tasks(*(asyncio.all_tasks() - {asyncio.current_task()}))
            await loop.shutdown_asyncgens()
            await loop.shutdown_default_executor()

        with suppress(TimeoutError):
            asyncio.run_coroutine_threadsafe(cancel(), loop).result(_CLOSE_WITHIN)
        loop.call_soon_threadsafe(loop.stop)
        self._thread.join(_CLOSE_WITHIN)
        if not self._thread.is_alive():
            loop.close()

    def _restore_signals(self) -> None:
        if threading.current_thread() is threading.main_thread():  # else the end of the ``with`` does it
            for number, handler in self._restore:
                signal.signal(number, handler)
            self._restore.clear()

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        if self._closing:
            self._restore_signals()
            signal.raise_signal(number)
        else:
            self._stopped.set()
            raise KeyboardInterrupt


async def _next(items: AsyncIterator[_T]) -> _T | None:
    return await anext(items, None)
