"""The way to ROS 2: what the neighbour asks of it. A Zenoh session is one, a process with rclpy another."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from rmpa.agent.trust import trust_store
from rmpa.core.errors import StartError
from rmpa.gateway.ros2.rclpy_session import RclpySession

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.bridge.policy import Needs
    from rmpa.config.settings import Settings
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

    def put(self, payload: Buffer, attachment: bytes = b"") -> int:
        """Queue one message; return how many older ones were dropped."""

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


def pythons(chosen: str, environ: Mapping[str, str]) -> list[str]:
    """The Pythons that may be ROS 2's: the chosen one alone, else each ``python3`` of PATH, then the system's."""
    if chosen:
        return [chosen]
    folders = [*environ.get("PATH", "").split(os.pathsep), "/usr/bin"]
    found = dict.fromkeys(Path(folder).resolve() / "python3" for folder in folders if folder.startswith("/"))
    return [str(each) for each in found if os.access(each, os.X_OK)]


async def open_rclpy_session(settings: Settings) -> RclpySession:
    """Start ROS 2's half by the first Python that has rclpy.

    Raises:
        StartError: None has it; or the mesh is secured and ROS 2 is not, and ``gateway.insecure`` is not set.
    """
    gateway, environ = settings.gateway, dict(os.environ)
    store = trust_store(settings)
    secured = store is not None and store.exists
    if secured and not gateway.insecure and environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        problem = "is not secured, and this module is in a secured mesh"
        remedy = "set ROS_SECURITY_ENABLE=true and its keystore (SROS 2), or say --insecure"
        raise StartError("ROS 2", problem, remedy, code="no-rclpy")
    asked: list[str] = []
    for python in pythons(gateway.ros2.python, environ):
        session = RclpySession(python, gateway.ros2.domain, settings.name, environ)
        try:
            await session.start()
        except StartError as error:
            asked.append(str(error.problem))
            continue
        return session
    problem = "; ".join(asked) or "no python3 was found"
    remedy = "source ROS 2 (source /opt/ros/<distribution>/setup.bash), or name its Python with --ros2-python"
    raise StartError("ROS 2", problem, remedy, code="no-rclpy")
