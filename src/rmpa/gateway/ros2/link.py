"""The way to ROS 2: what the neighbour asks of it. A Zenoh session is one, a process with rclpy another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.policy import Needs
    from rmpa.gateway.zenoh.threads import ZenohQos, ZenohReply, ZenohSample
    from rmpa.runtime.tls import Buffer


# What the ways to ROS 2 can and need, as docs/guides/ros2.md shows it: a row, and what holds by rclpy and by Zenoh.
WAYS: Final = (
    ("ROS 2 where the gateway runs", "needed", "not needed"),
    ("nodes that are reached", "of any RMW of yours", "of rmw_zenoh"),
    ("a router", "no", "`rmw_zenohd`"),
    ("types", "installed in ROS 2 there", "learnt from the node"),
    ("QoS", "ROS 2's own, enforced", "reliability and durability"),
    ("security", "SROS 2", "TLS of the mesh"),
)


class Declared(Protocol):
    """Something that was declared."""

    def close(self) -> None:
        """Take it back."""


class Publishing(Declared, Protocol):
    """A publisher with a bounded queue."""

    dropped: int

    @property
    def waiting(self) -> int:
        """Messages in its queue."""

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> int:
        """Queue messages, each with its attachment; return how many older ones were dropped."""


class Query(Protocol):
    """A call that has come."""

    key: str
    payload: bytes
    attachment: bytes

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        """Answer it."""

    def reply_error(self, text: str) -> None:
        """Answer that it has failed, and finish."""

    def finish(self) -> None:
        """Say that no more answers come."""


class Ros2Link(Protocol):
    """Endpoints, messages and calls by rmw_zenoh's tokens and keys.

    Attributes:
        zid: Identifies this gateway among others.
    """

    zid: str

    @property
    def endpoints(self) -> tuple[str, ...]:
        """What it is connected to."""

    def token(self, key: str) -> Declared:
        """Declare a node or an endpoint."""

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> Declared:
        """Call ``on_token(token, alive)`` for each node and endpoint that is there, and at each change."""

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> Publishing:
        """Make a publisher; ``on_matching(there)`` tells whether there is a subscriber."""

    def subscribe(self, key: str, on_sample: Callable[[ZenohSample], None], *, history: bool = False) -> Declared:
        """Give what is published by a key to a function; ``history``: also what publishers keep."""

    def queryable(self, key: str, on_query: Callable[[Any], object], _needs: Needs | None = None) -> Declared:
        """Give calls of a service to a function, each as a ``Query``."""

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,  # noqa: ASYNC109 - a Zenoh query ends by itself
        all_complete: bool = False,
    ) -> list[ZenohReply]:
        """Call a service; an empty list: no answer came within ``timeout`` seconds."""
