"""What the parts of a session share: handles, what is to be sent, and status messages."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.web.rosbridge.encodings import Compression, encode_cbor, encode_png
from rmpa.web.rosbridge.fragments import split
from rmpa.web.rosbridge.protocol import Id, OpError, RosbridgeFrame, status, whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

    from rmpa.web.hub.requests import HubRequest
    from rmpa.web.hub.types import TypeLibrary
    from rmpa.web.rosbridge.rosapi import HubGraph

LEVELS: Final = ("none", "error", "warning", "info")
"""Each includes those before it."""


class SessionContext:
    """The session's side towards the client and the hub.

    Args:
        types: Finds definitions.
        graph: The snapshot of the graph.
        ros_time_ns: The present ROS time in nanoseconds.
    """

    def __init__(self, types: TypeLibrary, graph: HubGraph, ros_time_ns: Callable[[], int]) -> None:
        self.types = types
        self.graph = graph
        self.ros_time_ns = ros_time_ns
        self.level = "error"
        self.frames: list[RosbridgeFrame] = []
        self.requests: list[HubRequest] = []
        self._handles = itertools.count(1)
        self._fragment_ids = itertools.count()

    def new_handle(self) -> int:
        """A handle that was never used in this session."""
        return next(self._handles)

    def ask(self, request: HubRequest) -> None:
        """Send a request to the hub."""
        self.requests.append(request)

    def status(self, level: str, text: str, mid: Id = None) -> None:
        """Send a status message, if the client wants those of this level."""
        if LEVELS.index(level) <= LEVELS.index(self.level):
            self.frames.append(status(level, text, mid))

    def send(self, frame: RosbridgeFrame, fragment_size: int | None = None, mid: Id = None) -> None:
        """Send a frame, in fragments where it is text and longer than `fragment_size` characters."""
        if fragment_size is None:
            self.frames.append(frame)
            return
        try:
            self.frames += split(frame, fragment_size, mid if mid is not None else next(self._fragment_ids))
        except OpError as error:
            self.status("error", str(error), mid)

    def send_op(self, values: Mapping[str, Any], style: Style, mid: Id = None) -> None:
        """Send an op that answers one of the client's, in the style that it asked for."""
        if style.compression >= Compression.CBOR:
            self.send(encode_cbor(values))
            return
        text = msgspec.json.encode(values)
        frame = encode_png(text) if style.compression is Compression.PNG else RosbridgeFrame((text,))
        self.send(frame, style.fragment_size, mid)


class Style(msgspec.Struct, frozen=True):
    """How a client wants an answer."""

    compression: Compression = Compression.NONE
    fragment_size: int | None = None

    @classmethod
    def parse(cls, compression: str | None, fragment_size: float | None) -> Style:
        """Read it from an op.

        Raises:
            OpError: The compression is unknown, or the size not 1 or more.
        """
        return cls(Compression.parse(compression), fragment_of(fragment_size))


def fragment_of(size: float | None) -> int | None:
    """A fragment size in characters; None for whole messages.

    Raises:
        OpError: It is not 1 or more.
    """
    return None if size is None else whole(size, "fragment_size", 1)


def check_count(count: int, limit: int, what: str) -> None:
    """Refuse one more where `count` are there.

    Raises:
        OpError: The limit is reached.
    """
    if count >= limit:
        raise OpError(f"this client has {count} {what} already", f"{limit} are allowed; end some first")
