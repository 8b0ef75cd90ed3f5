"""Services that clients call and serve, and files of ROS packages.

Files of ROS packages, for clients that draw a robot: ``package://NAME/PATH``.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import os
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import Access
from rmpa.core.errors import LimitExceeded, PeerRefused, RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.endpoints import probe
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits
from rmpa.web.hub.node_link import EndingRegistrations, Registration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.ros.node.node import Node, Service
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.tcpros import ServiceDescription
    from rmpa.web.hub.node_link import Key, NodeLink
    from rmpa.web.hub.requests import Payload

_SCHEME: Final = "package://"
_MANIFESTS: Final = ("package.xml", "manifest.xml")


class AssetError(RmpaError):
    """A file cannot be had."""


def read_asset(uri: str, most: int, environ: Mapping[str, str]) -> bytes:
    """Read a file of a package; this blocks.

    Args:
        uri: ``package://NAME/PATH``.
        most: Bytes.
        environ: Has ROS_PACKAGE_PATH and CMAKE_PREFIX_PATH.

    Raises:
        AssetError: There is no such package or file, or it is outside of the package.
        LimitExceeded: The file is larger than ``most``.
    """
    package, _, path = uri.removeprefix(_SCHEME).partition("/")
    if not uri.startswith(_SCHEME) or not package or not path or "\0" in path:
        raise AssetError(f"{uri[:200]!r} is not the file of a package; write package://NAME/PATH")
    try:
        return _find(package, path, most, environ)
    except OSError as error:  # such as a name that is too long
        raise AssetError(f"{uri[:200]} cannot be read: {error.strerror}") from error


def _find(package: str, path: str, most: int, environ: Mapping[str, str]) -> bytes:
    found = False
    for folder in _folders(package, environ):
        found = True
        root = folder.resolve()
        file = (root / path).resolve()
        if not file.is_relative_to(root):
            raise AssetError(f"{path[:200]} is outside of its package {package[:200]}")
        if file.is_file():
            return _read(file, most)
    if found:
        raise AssetError(f"package {package} has no file {path[:200]}")
    raise AssetError(f"package {package[:200]} is not found; source its workspace where rmpa web starts")


def _read(file: Path, most: int) -> bytes:
    try:
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > most:
                raise LimitExceeded(f"asset {file.name}", size, most)
            return stream.read(most)
    except OSError as error:
        raise AssetError(f"{file.name} cannot be read: {error.strerror}") from error


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
    for _ in range(limits.PACKAGES_WALKED):
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


# Services that clients offer: the node serves them, and hands each call to its client.


@dataclass(slots=True, eq=False)
class _Served:
    name: str
    key: Key
    kind: ServiceType
    request: Callable[[int, bytes], None]
    failed: Callable[[RmpaError], None]
    registration: Registration[Service] | None = None
    calls: dict[int, asyncio.Future[Payload]] = field(default_factory=dict)


class ServedServices:
    """All services that clients offer.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._served: dict[str, _Served] = {}
        self._ending: EndingRegistrations[Service] = EndingRegistrations()
        self._numbers = itertools.count(1)

    def serve(
        self,
        key: Key,
        name: str,
        kind: ServiceType,
        request: Callable[[int, bytes], None],
        failed: Callable[[RmpaError], None],
    ) -> None:
        """Offer a service; a client that offers it already loses it, which may have gone without a word.

        Args:
            key: The client and its handle.
            name: The global name.
            kind: Its type.
            request: ``(call, payload)``: hands a call to the client, which answers by ``respond``.
            failed: Called where the service cannot be registered, or another client offers it; it has then ended.

        Raises:
            PeerRefused: The rules deny it.
        """
        self._link.rules.check(Access.SERVE, name)
        if (old := self._served.get(name)) is not None:
            self._refused(old, RmpaError(f"another client offers {name} now"))
        served = self._served[name] = _Served(name, key, kind, request, failed)
        served.registration = Registration(
            self._link,
            name,
            functools.partial(self._register, served),
            _withdraw,
            functools.partial(self._refused, served),
            after=self._ending.take(name),
        )

    def respond(self, key: Key, name: str, call: int, *, ok: bool, response: Payload | str) -> None:
        """Answer a call; one that has ended is ignored."""
        served = self._served.get(name)
        future = served.calls.get(call) if served is not None and served.key == key else None
        if future is None or future.done():
            return
        if ok and not isinstance(response, str):
            future.set_result(response)
        else:
            future.set_exception(RmpaError(str(response)))

    def end(self, key: Key, name: str) -> None:
        """End a service; its open calls fail."""
        served = self._served.get(name)
        if served is not None and served.key == key:
            self._end(served)

    async def close(self) -> None:
        """End all, after the node was closed."""
        for served in [*self._served.values()]:
            self._end(served)
        await self._ending.closed()

    # --- inside -----------------------------------------------------------------------------------------------

    async def _register(self, served: _Served, node: Node) -> Service:
        handler = functools.partial(self._call, served)
        return await node.advertise_service(
            served.name, served.kind, handler, timeout=limits.SERVED_TIMEOUT, raw=True
        )

    async def _call(self, served: _Served, request: bytes) -> Payload:
        if len(served.calls) >= limits.SERVED_CALLS_MAX:
            raise RmpaError(f"{len(served.calls)} calls of {served.name} wait for its client, which is the limit")
        number = next(self._numbers)
        future: asyncio.Future[Payload] = asyncio.get_running_loop().create_future()
        served.calls[number] = future
        try:
            served.request(number, request)
            return await future
        finally:
            del served.calls[number]

    def _refused(self, served: _Served, error: RmpaError) -> None:
        if self._served.get(served.name) is served:
            self._end(served)
            served.failed(error)

    def _end(self, served: _Served) -> None:
        del self._served[served.name]
        for future in served.calls.values():
            if not future.done():
                future.set_exception(RmpaError(f"the client that offers {served.name} has ended it"))
        if served.registration is not None:
            self._ending.end(served.name, served.registration)


async def _withdraw(service: Service) -> None:
    await service.close()


# Services that clients call: a few open connections to each server, shared by all clients.


@dataclass(frozen=True, slots=True)
class FoundService:
    """What a server has said of its service."""

    type: str
    uri: str


@dataclass(slots=True, eq=False)
class _Server:
    """The connections to the server of one service, for one md5 sum."""

    slots: asyncio.Semaphore
    idle: list[tuple[ServiceConnection, float]] = field(default_factory=list)
    busy: set[ServiceConnection] = field(default_factory=set)
    users: int = 0


class ServiceCalls:
    """Calls services, and asks servers for their types.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._servers: dict[tuple[str, str], _Server] = {}
        self._sweep: asyncio.TimerHandle | None = None
        self._found: dict[str, FoundService] = {}
        self._finding: dict[str, asyncio.Future[FoundService]] = {}
        self._probes = asyncio.Semaphore(limits.PROBES_AT_ONCE)

    @property
    def found(self) -> dict[str, FoundService]:
        """What is known of services, by name."""
        return self._found

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
        server = self._servers.get(key)
        if server is None:
            server = self._servers[key] = _Server(asyncio.Semaphore(limits.CALLS_AT_ONCE))
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
            if not server.users and not server.idle and self._servers.get(key) is server:
                del self._servers[key]
        if not ok:
            raise PeerRefused(f"service {service}", str(bytes(body), "utf-8", "replace"))
        return body

    async def find(self, service: str) -> FoundService:
        """Ask a service's server for its type; the answer is kept until ``forget``.

        Raises:
            RmpaError: There is no such service, or its server does not answer.
        """
        found = self._found.get(service)
        if found is not None:
            return found
        asked = self._finding.get(service)
        if asked is None:
            asked = self._finding[service] = asyncio.ensure_future(self._probe(service))
            asked.add_done_callback(lambda _: self._finding.pop(service, None))
        return await asyncio.shield(asked)

    def forget(self, service: str) -> None:
        """The service has another provider, or none: forget what is known of it, and connect anew."""
        self._found.pop(service, None)
        for (name, _), server in self._servers.items():
            if name == service:
                for connection, _ in server.idle:
                    connection.close()
                server.idle.clear()

    async def close(self) -> None:
        """Close all connections; the callers have been cancelled before."""
        if self._sweep is not None:
            self._sweep.cancel()
        asked = [*self._finding.values()]
        for each in asked:
            each.cancel()
        await asyncio.gather(*asked, return_exceptions=True)
        for server in self._servers.values():
            for connection in [*(each for each, _ in server.idle), *server.busy]:
                connection.close()
        self._servers.clear()

    # --- inside -----------------------------------------------------------------------------------------------

    async def _exchange(
        self, server: _Server, key: tuple[str, str], request: Payload
    ) -> tuple[bool, bytes | bytearray]:
        while True:
            connection, fresh = await self._take(server, key)
            server.busy.add(connection)
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
                self._give_back(server, connection)
                return result
            finally:
                server.busy.discard(connection)

    async def _take(self, server: _Server, key: tuple[str, str]) -> tuple[ServiceConnection, bool]:
        while server.idle:
            connection, _ = server.idle.pop()
            if not connection.closed:
                return connection, False
        service, md5sum = key
        node = self._link.need()
        uri = await node.lookup_service(service)
        return await ServiceConnection.open(uri, service, node.name, md5sum=md5sum), True

    def _give_back(self, server: _Server, connection: ServiceConnection) -> None:
        loop = asyncio.get_running_loop()
        if not connection.closed:
            server.idle.append((connection, loop.time()))
        if self._sweep is None:
            self._sweep = loop.call_later(limits.CALL_IDLE, self._close_unused)

    def _close_unused(self) -> None:
        loop = asyncio.get_running_loop()
        self._sweep = None
        before = loop.time() - limits.CALL_IDLE
        for key, server in [*self._servers.items()]:
            for connection, since in server.idle:
                if since <= before:
                    connection.close()
            server.idle = [each for each in server.idle if not each[0].closed]
            if not server.users and not server.idle:
                del self._servers[key]
        if self._servers:
            self._sweep = loop.call_later(limits.CALL_IDLE / 2, self._close_unused)

    async def _probe(self, service: str) -> FoundService:
        async with self._probes:
            node = self._link.need()
            uri = await node.lookup_service(service)
            opened = await probe(uri, service, node.name, ros_limits.SERVICE_OPEN_TIMEOUT)
        description: ServiceDescription = opened.description
        if not description.type or description.type == ANY:
            raise RmpaError(f"the server of {service} does not tell its type")
        found = self._found[service] = FoundService(description.type, uri)
        return found
