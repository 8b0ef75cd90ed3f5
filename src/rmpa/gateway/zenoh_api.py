"""What the neighbours need of Zenoh; ``gateway.zenoh`` implements it with one session.

All methods are called in the event loop, and so are all callbacks: Zenoh's threads hand over by a queue. Nothing here
blocks. The library is imported only by ``gateway.zenoh``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.permission_gate import Needs
    from rmpa.ros.wire.tcpros import Buffer


class ZenohPriority(IntEnum):
    """Zenoh's priorities; a lower number goes first."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    INTERACTIVE_LOW = 3
    DATA_HIGH = 4
    DATA = 5
    DATA_LOW = 6
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class ZenohQos:
    """The QoS of one publisher, and the bounds of its queue in this process.

    Args:
        reliable: Zenoh's reliability ``RELIABLE``; else ``BEST_EFFORT``.
        block: Congestion control ``BLOCK`` (it waits in a thread of its own); else ``DROP``.
        priority: Zenoh's priority.
        messages: Messages that wait at most; above it the oldest is dropped, and counted.
        bytes: Bytes that wait at most; one message always fits.
        cache: Samples that a later subscriber gets (an advanced publisher); 0: an ordinary publisher.
    """

    reliable: bool = True
    block: bool = True
    priority: ZenohPriority = ZenohPriority.DATA
    messages: int = 1000
    bytes: int = 64 * 1024 * 1024
    cache: int = 0


@dataclass(frozen=True, slots=True)
class ZenohSample:
    """One message that was received.

    Args:
        key: Its key.
        payload: Its bytes.
        attachment: Its attachment; empty if it has none.
    """

    key: str
    payload: bytes
    attachment: bytes


@dataclass(frozen=True, slots=True)
class ZenohReply:
    """One answer to ``get``.

    Args:
        key: The key that was answered; empty for an error.
        payload: The answer, or the error's text in UTF-8.
        attachment: Its attachment; empty if it has none.
        ok: Whether it is an answer and no error.
    """

    key: str
    payload: bytes
    attachment: bytes
    ok: bool


class ZenohQuery(Protocol):
    """One query that has come; it is answered once, or not at all (``finish``)."""

    key: str
    """The key expression that is asked."""
    parameters: str
    payload: bytes
    attachment: bytes

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        """Give one answer; more may follow until ``finish``."""

    def reply_error(self, text: str) -> None:
        """Answer with an error, and finish."""

    def finish(self) -> None:
        """Say that no more answers come."""


class Declared(Protocol):
    """A subscriber, a token, a queryable: declared until it is closed."""

    def close(self) -> None:
        """Undeclare it; no callback is called afterwards."""


class ZenohPublisher(Protocol):
    """A declared publisher behind a bounded queue."""

    sent: int
    """Messages handed to Zenoh."""
    dropped: int
    """Messages that the queue dropped."""

    @property
    def waiting(self) -> int:
        """Messages in the queue."""

    def put(self, payload: Buffer, attachment: bytes = b"") -> int:
        """Queue one message; the payload is copied if it is not ``bytes``. Returns the messages dropped for it."""

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> int:
        """Queue messages, each with its attachment, in order; returns the messages dropped for them."""

    def close(self) -> None:
        """Undeclare it, after the queue is empty or a second has passed."""


class ZenohSession(Protocol):
    """One open session."""

    zid: str
    """The session's id, hexadecimal, as in ROS 2's tokens."""

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> ZenohPublisher:
        """Declare a publisher; ``on_matching(there)`` tells whether there is a subscriber, also at the beginning."""

    def subscribe(
        self,
        key: str,
        on_sample: Callable[[ZenohSample], None],
        *,
        history: bool = False,
    ) -> Declared:
        """Subscribe to a key expression; ``history``: ask publishers with a cache for what they keep."""

    def token(self, key: str) -> Declared:
        """Declare a liveliness token."""

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> Declared:
        """Call ``on_token(key, alive)`` for each token that is there, and at each change."""

    def queryable(
        self, key: str, on_query: Callable[[ZenohQuery], None], _needs: Needs, *, complete: bool = True
    ) -> Declared:
        """Answer queries; ``on_query`` asks for the permissions that ``_needs`` declares."""

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,  # noqa: ASYNC109
        all_complete: bool = False,
        priority: ZenohPriority = ZenohPriority.DATA,
    ) -> list[ZenohReply]:
        """Ask; wait for all answers, or for ``timeout`` seconds. ``all_complete``: ask every complete queryable."""


class OwnedSession(ZenohSession, Protocol):
    """An open session, for its owner."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The endpoints of the other side of each link that is up now."""

    @property
    def stale(self) -> bool:
        """Whether it has to be opened anew for others to connect to it: its certificate was renewed."""

    def take_refused(self) -> dict[str, int]:
        """What was dropped or refused since the last call, by its reason, such as ``zenoh.reply.limit``."""

    async def close(self) -> None:
        """Close it and end its threads."""
