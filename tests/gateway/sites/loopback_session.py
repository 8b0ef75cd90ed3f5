"""A Zenoh session that has all its queryables in this process, for the parts of sites."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.gateway.neighbour import ZenohPriority, ZenohReply

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.wire.tcpros import Buffer


def fits(one: str, other: str) -> bool:
    """Whether two key expressions intersect."""

    def chunks(first: list[str], second: list[str]) -> bool:
        if not first or not second:
            return all(chunk == "**" for chunk in (*first, *second))
        if first[0] == "**":
            return chunks(first[1:], second) or chunks(first, second[1:])
        if second[0] == "**":
            return chunks(second, first)
        return (first[0] == second[0] or "*" in (first[0], second[0])) and chunks(first[1:], second[1:])

    return chunks(one.split("/"), other.split("/"))


@dataclass(eq=False)
class LoopbackQuery:
    """A query, and its replies."""

    key: str
    parameters: str
    payload: bytes
    attachment: bytes
    replies: list[ZenohReply] = field(default_factory=list)
    done: asyncio.Event = field(default_factory=asyncio.Event)

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        assert not self.done.is_set()
        self.replies.append(ZenohReply(key, bytes(payload), attachment, True))

    def reply_error(self, text: str) -> None:
        assert not self.done.is_set()
        self.replies.append(ZenohReply("", text.encode(), b"", False))
        self.done.set()

    def finish(self) -> None:
        self.done.set()


@dataclass(eq=False)
class LoopbackDeclared:
    """Something that is declared."""

    undeclare: Callable[[], None]

    def close(self) -> None:
        self.undeclare()


class LoopbackSession:
    """Only queryables and ``get``."""

    def __init__(self) -> None:
        self.queryables: dict[LoopbackDeclared, tuple[str, Callable[[LoopbackQuery], None]]] = {}
        self.asked: list[LoopbackQuery] = []

    def queryable(
        self, key: str, on_query: Callable[[LoopbackQuery], None], _needs: object = None, *, complete: bool = True
    ) -> LoopbackDeclared:
        assert complete
        declared = LoopbackDeclared(lambda: self.queryables.pop(declared, None) and None)
        self.queryables[declared] = key, on_query
        return declared

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,
        all_complete: bool = False,
        priority: ZenohPriority = ZenohPriority.DATA,
    ) -> list[ZenohReply]:
        del all_complete, priority
        key, _, parameters = selector.partition("?")
        found = [on_query for declared, on_query in self.queryables.values() if fits(declared, key)]
        replies: list[ZenohReply] = []
        for on_query in found:
            query = LoopbackQuery(key, parameters, bytes(payload), attachment)
            self.asked.append(query)
            on_query(query)
            try:
                async with asyncio.timeout(timeout):
                    await query.done.wait()
            except TimeoutError:
                pass
            replies += query.replies
        return replies
