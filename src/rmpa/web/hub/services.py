"""Services that clients call and serve, and files of ROS packages for clients that draw a robot."""

from __future__ import annotations

import asyncio
import os
from collections import defaultdict, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from rmpa.config.peer_rules import Access
from rmpa.core.errors import LimitExceeded, PeerRefused, RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.wire.tcpros import ANY
from rmpa.runtime.tasks import end_tasks, start_task
from rmpa.web import limits
from rmpa.web.hub.node_link import NodeLink, Payload, Registration

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping

    from rmpa.ros.node.node import Node, Service
    from rmpa.ros.types.installed import ServiceType

_K = TypeVar("_K")
_T = TypeVar("_T")


class SharedTasks(Generic[_K, _T]):
    """Answers that take time, each found by one task for all who ask for it meanwhile."""

    def __init__(self) -> None:
        self._tasks: dict[_K, asyncio.Task[_T]] = {}

    def start(self, key: _K, find: Callable[[], Coroutine[object, object, _T]]) -> asyncio.Task[_T]:
        """The task that finds this; nothing need wait for it."""
        task = self._tasks.get(key)
        if task is None:
            task = self._tasks[key] = start_task(find(), f"find {key}", raises=(RmpaError,))
            task.add_done_callback(lambda _: self._tasks.pop(key))
        return task

    async def get(self, key: _K, find: Callable[[], Coroutine[object, object, _T]]) -> _T:
        """The answer; raises what ``find`` raises."""
        return await asyncio.shield(self.start(key, find))

    async def close(self) -> None:
        """End all."""
        await end_tasks(*self._tasks.values())


_SCHEME: Final = "package://"
_MANIFESTS: Final = ("package.xml", "manifest.xml")


def read_asset(uri: str, most: int, environ: Mapping[str, str]) -> bytes:
    """Read a file of a package; this blocks.

    Args:
        uri: ``package://NAME/PATH``.
        most: Bytes.
        environ: Has ROS_PACKAGE_PATH and CMAKE_PREFIX_PATH.

    Raises:
        RmpaError: There is no such package or file, or it is outside of the package.
        LimitExceeded: The file is larger than ``most``.
    """
    package, _, path = uri.removeprefix(_SCHEME).partition("/")
    if not uri.startswith(_SCHEME) or not package or not path or "\0" in path:
        raise RmpaError(f"{uri[:200]!r} is not the file of a package; write package://NAME/PATH")
    try:
        return _find(package, path, most, environ)
    except OSError as error:  # such as a name that is too long
        raise RmpaError(f"{uri[:200]} cannot be read: {error.strerror}", code="unknown-name") from error


def _find(package: str, path: str, most: int, environ: Mapping[str, str]) -> bytes:
    found = False
    for folder in _folders(package, environ):
        found = True
        root = folder.resolve()
        file = (root / path).resolve()
        if not file.is_relative_to(root):
            raise RmpaError(f"{path[:200]} is outside of its package {package[:200]}")
        if file.is_file():
            with file.open("rb") as stream:
                data = stream.read(most + 1)
            if len(data) > most:
                raise LimitExceeded(f"asset {file.name}", file.stat().st_size, most)
            return data
    if found:
        raise RmpaError(f"package {package} has no file {path[:200]}", code="unknown-name")
    raise RmpaError(
        f"package {package[:200]} is not found; source its workspace where rmpa web starts", code="unknown-name"
    )


def _folders(package: str, environ: Mapping[str, str]) -> Iterator[Path]:
    """The folders of a package, best first."""
    if package in (".", "..") or os.sep in package:
        return
    sourced = [entry for entry in environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if entry]
    prefixes = [entry for entry in environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep) if entry]
    roots = [*map(Path, sourced), *(Path(prefix, "share") for prefix in prefixes), Path("/usr/share")]
    for root in roots:
        if _is_package(root / package):
            yield root / package
    for entry in sourced:
        yield from _walk(Path(entry), package)


def _walk(root: Path, package: str) -> Iterator[Path]:
    """The folders of this name below ``root`` that are packages, nearest first; none is within another package."""
    waiting = deque([root])
    for _ in range(20_000):
        if not waiting:
            return
        folder = waiting.popleft()
        try:
            below = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir() and entry.name[0] != ".")
        except OSError:
            continue
        for each in map(Path, below):
            if _is_package(each):
                if each.name == package and each.parent != root:
                    yield each
            elif not (each / "CATKIN_IGNORE").exists():
                waiting.append(each)


def _is_package(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _MANIFESTS)


class ServedService:
    """A service that a client offers: the node serves it, and each call is handed to its client.

    A client that offers it already loses it, which may have gone without a word.

    Args:
        link: Has the node.
        served: All such services, by name.
        name: The global name.
        kind: Its type.
        called: ``(request, response)``: hands a call to the client, which sets the response or an exception.
        failed: Called where the service cannot be registered, or another client offers it; it has then ended.

    Raises:
        PeerRefused: The rules deny it.
    """

    def __init__(
        self,
        link: NodeLink,
        served: dict[str, ServedService],
        name: str,
        kind: ServiceType,
        called: Callable[[bytes, asyncio.Future[Payload]], None],
        failed: Callable[[RmpaError], None],
    ) -> None:
        link.rules.check(Access.SERVE, name)
        self._name = name
        self._kind = kind
        self._called = called
        self._failed = failed
        self._served = served
        self._calls: set[asyncio.Future[Payload]] = set()
        if (old := served.get(name)) is not None:
            old.refused(RmpaError(f"another client offers {name} now"))
        served[name] = self
        self._registration: Registration[Service] = Registration(link, "service", name, self._register, self.refused)

    def close(self, reason: str = "") -> None:
        """Offer it no more, once; its open calls fail."""
        if self._served.get(self._name) is not self:
            return
        del self._served[self._name]
        for response in self._calls:
            if not response.done():
                response.set_exception(RmpaError(reason or f"the client that offers {self._name} has ended it"))
        self._registration.end()

    async def _register(self, node: Node) -> Service:
        return await node.advertise_service(self._name, self._kind, self._call, timeout=60.0, raw=True)

    async def _call(self, request: bytes) -> Payload:
        if len(self._calls) >= limits.SERVED_CALLS_MAX:
            raise RmpaError(f"{len(self._calls)} calls of {self._name} wait for its client, which is the limit")
        response: asyncio.Future[Payload] = asyncio.get_running_loop().create_future()
        self._calls.add(response)
        try:
            self._called(request, response)
            return await response
        finally:
            self._calls.discard(response)

    def refused(self, error: RmpaError) -> None:
        """It cannot be offered: it ends, and its client is told."""
        if self._served.get(self._name) is self:
            self.close()
            self._failed(error)


@dataclass(slots=True, eq=False)
class _Server:
    """The connections to the server of one service, for one md5 sum."""

    slots: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(limits.CALLS_AT_ONCE))
    idle: dict[ServiceConnection, asyncio.TimerHandle] = field(default_factory=dict)
    users: int = 0


class ServiceCalls:
    """Calls services over a few connections to each server, and asks servers for their types, for all clients.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._servers: defaultdict[tuple[str, str], _Server] = defaultdict(_Server)
        self._finding: SharedTasks[str, tuple[str, str]] = SharedTasks()
        self._probes = asyncio.Semaphore(8)  # servers that are asked for their service's type at one time
        # The types and URIs that servers have told, by the service's name.
        self.found: dict[str, tuple[str, str]] = {}

    async def call(self, service: str, md5sum: str, request: Payload, timeout: float | None) -> Payload:  # noqa: ASYNC109
        """Call a service.

        Args:
            service: The global name.
            md5sum: Of its type; empty for any.
            request: Serialized.
            timeout: Seconds for all; ``None`` for ``limits.CALL_TIMEOUT``.

        Returns:
            The serialized response.

        Raises:
            RmpaError: The call failed; the text says why.
        """
        self._link.rules.check(Access.CALL, service)
        seconds = limits.CALL_TIMEOUT if timeout is None else min(timeout, limits.CALL_TIMEOUT_MAX)
        key = service, md5sum or ANY
        server = self._servers[key]
        if server.users >= limits.CALLS_WAITING + limits.CALLS_AT_ONCE:
            raise ServiceFailed(service, f"{limits.CALLS_WAITING} calls wait for its server already", sent=False)
        server.users += 1
        try:
            async with asyncio.timeout(seconds), server.slots:
                ok, body = await self._exchange(server, key, request)
        except TimeoutError:
            raise ServiceFailed(service, f"no answer within {seconds:g} s") from None
        finally:
            server.users -= 1
            self._forget_unused(key)
        if not ok:
            raise PeerRefused(f"service {service}", str(bytes(body), "utf-8", "replace"), code="service-failed")
        return body

    async def find(self, service: str) -> tuple[str, str]:
        """Ask a service's server for its type; the answer, with its URI, is kept until ``forget``.

        Raises:
            RmpaError: There is no such service, or its server does not answer.
        """
        return self.found.get(service) or await self._finding.get(service, lambda: self._probe(service))

    def forget(self, services: Iterable[str]) -> None:
        """These have other providers, or none: forget what is known of them, and connect anew."""
        names = {*services}
        for name in names:
            self.found.pop(name, None)
        for key in [key for key in self._servers if key[0] in names]:
            for connection in [*self._servers[key].idle]:
                self._drop(key, connection)

    async def close(self) -> None:
        """Close all connections; the callers have been cancelled before."""
        await self._finding.close()
        for key, server in [*self._servers.items()]:
            for connection in [*server.idle]:
                self._drop(key, connection)

    async def _exchange(
        self, server: _Server, key: tuple[str, str], request: Payload
    ) -> tuple[bool, bytes | bytearray]:
        while True:
            connection, fresh = await self._take(server, key)
            try:
                result = await connection.call(request)
            except ServiceFailed as error:
                connection.close()
                if error.sent or fresh:
                    raise
            except BaseException:
                connection.close()
                raise
            else:
                if not connection.closed:
                    loop = asyncio.get_running_loop()
                    # An unused connection stays open for so long.
                    server.idle[connection] = loop.call_later(10.0, self._drop, key, connection)
                return result

    async def _take(self, server: _Server, key: tuple[str, str]) -> tuple[ServiceConnection, bool]:
        while server.idle:
            connection, timer = server.idle.popitem()
            timer.cancel()
            if not connection.closed:
                return connection, False
        service, md5sum = key
        node = self._link.need()
        uri = await node.lookup_service(service)
        return await ServiceConnection.open(uri, service, node.name, md5sum=md5sum), True

    def _drop(self, key: tuple[str, str], connection: ServiceConnection) -> None:
        self._servers[key].idle.pop(connection).cancel()
        connection.close()
        self._forget_unused(key)

    def _forget_unused(self, key: tuple[str, str]) -> None:
        server = self._servers.get(key)
        if server is not None and not server.users and not server.idle:
            del self._servers[key]

    async def _probe(self, service: str) -> tuple[str, str]:
        async with self._probes:
            node = self._link.need()
            uri = await node.lookup_service(service)
            opened = await ServiceConnection.probe(uri, service, node.name, ros_limits.SERVICE_OPEN_TIMEOUT)
        type_ = opened.description.type
        if not type_ or type_ == ANY:
            raise RmpaError(f"the server of {service} does not say its type")
        found = self.found[service] = type_, uri
        return found
