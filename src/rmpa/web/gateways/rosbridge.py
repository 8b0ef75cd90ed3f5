"""rosbridge v2 over a WebSocket."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.web.gateways.connection import ClientConnection, OutFrame
from rmpa.web.gateways.websocket_frames import Opcode
from rmpa.web.rosbridge.rosapi import HubGraph
from rmpa.web.rosbridge.session import RosbridgeSession

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import Answer, ReceivedMessage
    from rmpa.web.hub.rights import Rights
    from rmpa.web.rosbridge.encodings import PublishFrames
    from rmpa.web.rosbridge.protocol import RosbridgeFrame


class RosbridgeConnection(ClientConnection):
    """One rosbridge client; the arguments are those of ``ClientConnection``.

    Args:
        frames: Encodes messages, once for all clients.
    """

    kind = "rosbridge"

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        frames: PublishFrames,
    ) -> None:
        super().__init__(hub, rights, priority, address)
        graph = HubGraph(hub, rights)
        self._session = RosbridgeSession(hub.types, graph, hub.time.now_ns, frames=frames)

    def opened(self) -> None:
        """Count the client; nothing is sent first."""
        self.hub.counts.add(self.client.number, self.address)

    def received_frame(self, data: str | bytes) -> None:
        """A frame of the client."""
        self._session.receive_frame(data, self._loop.time())
        self._flush()

    def answered(self, answer: Answer) -> None:
        """An answer of the hub."""
        self._session.receive_answer(answer, self._loop.time())
        self._flush()

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frames of a message; none where it is throttled."""
        self._session.receive_answer(message, self._loop.time())
        frames = self._session.frames_to_send()
        # A message that is held back needs the timer; to ask for it at each message would take time.
        self._flush(arm=not frames)
        return (_out(frame) for frame in frames)

    def show_late(self, text: str) -> None:
        """A status of the level ``error``."""
        self._session.warn(text, "error")
        self._flush()

    def show_drops(self, dropped: dict[str, int]) -> None:
        """A status of the level ``warning``."""
        listed = ", ".join(f"{count} of {topic}" for topic, count in dropped.items())
        self._session.warn(f"this client is too slow; messages dropped so far: {listed}")
        self._flush()

    def next_timer(self) -> float | None:
        """The session's."""
        return self._session.next_timer()

    def handle_timer(self) -> None:
        """Do what is due."""
        self._session.handle_timer(self._loop.time())
        self._flush()

    def _flush(self, *, arm: bool = True) -> None:
        for frame in self._session.frames_to_send():
            self.push(_out(frame), frame.handle)
        for request in self._session.requests_to_send():
            self.ask(request)
        if arm:
            self.arm()


def _out(frame: RosbridgeFrame) -> OutFrame:
    return (Opcode.BINARY if frame.binary else Opcode.TEXT, frame.parts)
