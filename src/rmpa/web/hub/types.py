"""Definitions of message and service types: those that rmpa brings, this machine's, and those of publishers."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from typing import TYPE_CHECKING

from rmpa.core.counters import TokenBucket
from rmpa.core.errors import RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.fetch_type import fetch_type
from rmpa.ros.types.definitions import UnknownTypeError, known_text
from rmpa.ros.types.find import find_message_type, find_service_type, type_of_header
from rmpa.ros.types.installed import ServiceType, known_services
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.node_link import NodeLink

_log = logging.getLogger(__name__)


class TypeLibrary:
    """All types that are known, and those that clients wait for.

    A publisher's own definition replaces another version of the same name, because its messages have that form.

    Args:
        link: Has the node, whose publishers are asked.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._messages: OrderedDict[str, MessageType] = OrderedDict()
        self._versions: OrderedDict[tuple[str, str], MessageType] = OrderedDict()
        self._services: OrderedDict[str, ServiceType] = OrderedDict()
        self._missing: OrderedDict[tuple[str, bool], tuple[float, RmpaError]] = OrderedDict()
        self._finding: dict[str, asyncio.Future[MessageType]] = {}
        self._wanted: dict[str, dict[Key, Callable[[MessageType], None]]] = {}
        self._asked = asyncio.Semaphore(limits.DESCRIBE_AT_ONCE)
        self._searches = TokenBucket(limits.SEARCH_RATE, limits.SEARCH_BURST)

    # --- at once, for the sessions ---------------------------------------------------------------------------

    def message(self, name: str) -> MessageType:
        """A message type that is known or on this machine; its first search reads files.

        Raises:
            DefinitionError: It is not found; the error is repeated within ``limits.PROBE_RETRY``.
        """
        kind = self._messages.get(name)
        if kind is None:
            self._check_missing(name, service=False)
            if known_text(name) is None:
                self._search()
            try:
                kind = MessageType(name) if known_text(name) is not None else find_message_type(name)
            except RmpaError as error:
                if isinstance(error, UnknownTypeError) and error.fetchable:
                    self._start_finding(name)  # a publisher may tell it, for the next question
                raise self._remember(name, error, service=False) from None
            self._keep(name, kind)
        return kind

    def at_hand(self, name: str) -> MessageType | None:
        """A message type as ``message`` finds it, or ``None``."""
        try:
            return self.message(name)
        except RmpaError:
            return None

    def version(self, name: str, md5sum: str) -> MessageType:
        """The version of a message type that a publisher has; that of ``message`` where its md5 sum is not known.

        Modules may have been built with different versions of one type.

        Raises:
            DefinitionError: As for ``message``.
        """
        return self._versions.get((name, md5sum)) or self.message(name)

    def seen_version(self, name: str, md5sum: str) -> MessageType | None:
        """The version of a message type with that md5 sum, if it is known."""
        return self._versions.get((name, md5sum))

    def service(self, name: str) -> ServiceType:
        """A service type; as ``message``."""
        kind = self._services.get(name)
        if kind is None:
            self._check_missing(name, service=True)
            if name not in known_services():
                self._search()
            try:
                kind = ServiceType(name) if name in known_services() else find_service_type(name)
            except RmpaError as error:
                raise self._remember(name, error, service=True) from None
            self._services[name] = kind
            if len(self._services) > ros_limits.TYPES_FOUND_MAX:
                self._services.popitem(last=False)
        return kind

    # --- with time --------------------------------------------------------------------------------------------

    async def find_message(self, name: str) -> MessageType:
        """A message type that is known, on this machine, or told by a publisher.

        Raises:
            DefinitionError: None of them has it.
            UnreachableError: The master does not answer.
        """
        kind = self._messages.get(name)
        if kind is not None:
            return kind
        return await asyncio.shield(self._start_finding(name))

    async def find_service(self, name: str) -> ServiceType:
        """A service type that is known or on this machine.

        Raises:
            DefinitionError: It is not found.
        """
        if name not in self._services:
            self._check_missing(name, service=True)
            try:
                self._services[name] = await asyncio.to_thread(find_service_type, name)
            except RmpaError as error:
                raise self._remember(name, error, service=True) from None
        return self._services[name]

    def learn(self, header: Mapping[str, str]) -> None:
        """Take the definition of a publisher's header."""
        name = header.get("type", "")
        known = self._messages.get(name)
        md5sum = header.get("md5sum", "")
        if not name or (known is not None and known.md5sum == md5sum) or (name, md5sum) in self._versions:
            return
        if not header.get("message_definition"):
            return
        try:
            kind = type_of_header(header)
        except RmpaError as error:
            _log.debug("! the definition of %s by %s: %s", name, header.get("callerid"), error)
            return
        self._keep(name, kind)

    def want(self, key: Key, name: str, known: Callable[[MessageType], None]) -> None:
        """Call ``known`` once when a message type becomes known that was not found."""
        self._wanted.setdefault(name, {})[key] = known

    def forget_client(self, number: int) -> None:
        """Drop what a client wanted."""
        for name, wanted in [*self._wanted.items()]:
            for key in [key for key in wanted if key[0] == number]:
                del wanted[key]
            if not wanted:
                del self._wanted[name]

    @property
    def wanted(self) -> tuple[str, ...]:
        """The message types that clients wait for."""
        return tuple(self._wanted)

    async def close(self) -> None:
        """End all searches."""
        finding = [*self._finding.values()]
        for each in finding:
            each.cancel()
        await asyncio.gather(*finding, return_exceptions=True)

    # --- inside -----------------------------------------------------------------------------------------------

    def _start_finding(self, name: str) -> asyncio.Future[MessageType]:
        finding = self._finding.get(name)
        if finding is None:
            finding = self._finding[name] = asyncio.ensure_future(self._find(name))

            def found(finding: asyncio.Future[MessageType]) -> None:
                del self._finding[name]
                if not finding.cancelled():
                    finding.exception()  # nothing may wait for it

            finding.add_done_callback(found)
        return finding

    async def _find(self, name: str) -> MessageType:
        async with self._asked:
            try:
                kind = await asyncio.to_thread(find_message_type, name)
            except UnknownTypeError as error:
                node = self._link.need()
                fetched = await fetch_type(node.master_uri, node.name, name) if error.fetchable else None
                if fetched is None:
                    raise
                kind = fetched.kind
            return self._messages.get(name) or self._keep(name, kind)

    def _keep(self, name: str, kind: MessageType) -> MessageType:
        self._messages[name] = kind
        self._versions[name, kind.md5sum] = kind
        while len(self._versions) > ros_limits.TYPES_FOUND_MAX:
            self._versions.popitem(last=False)
        self._missing.pop((name, False), None)
        while len(self._messages) > ros_limits.TYPES_FOUND_MAX:
            self._messages.popitem(last=False)
        for known in self._wanted.pop(name, {}).values():
            known(kind)
        return kind

    def _search(self) -> None:
        """Count a search on this machine, which reads files, and walks through all packages for an unknown type.

        Raises:
            RmpaError: There were too many at once; the event loop serves robots too.
        """
        if not self._searches.take(asyncio.get_running_loop().time()):
            raise RmpaError("too many types were searched for at once; ask again in a second")

    def _check_missing(self, name: str, *, service: bool) -> None:
        when, error = self._missing.get((name, service), (0.0, None))
        if error is not None and asyncio.get_running_loop().time() - when < limits.PROBE_RETRY:
            raise error.with_traceback(None)

    def _remember(self, name: str, error: RmpaError, *, service: bool) -> RmpaError:
        self._missing[name, service] = asyncio.get_running_loop().time(), error
        while len(self._missing) > ros_limits.TYPES_MISSING_MAX:
            self._missing.popitem(last=False)
        return error
