"""The Foxglove WebSocket protocol over a WebSocket."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.web.foxglove.protocol import BinaryFrame, StatusLevel, TextFrame
from rmpa.web.foxglove.session import FoxgloveClose, FoxgloveSession
from rmpa.web.gateways.connection import ClientConnection, OutFrame
from rmpa.web.gateways.websocket_frames import Opcode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.web.foxglove.protocol import FoxgloveFrame
    from rmpa.web.foxglove.session import Output
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import Answer, ReceivedMessage
    from rmpa.web.hub.rights import Rights


class FoxgloveConnection(ClientConnection):
    """One Foxglove client; the arguments are those of ``ClientConnection``.

    Args:
        name: The server's, for users.
        session_id: The same for all clients of one run.
    """

    kind = "foxglove"

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        name: str,
        session_id: str,
    ) -> None:
        super().__init__(hub, rights, priority, address)
        self._session = FoxgloveSession(name, session_id, rights, sim_time=hub.time.simulated)

    def opened(self) -> None:
        """``serverInfo`` and the channels come first."""
        self._do(self._session.open())

    def received_frame(self, data: str | bytes) -> None:
        """A frame of the client."""
        self._do(self._session.receive(data, self._loop.time()))

    def answered(self, answer: Answer) -> None:
        """An answer of the hub."""
        self._do(self._session.answer(answer))

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frame of a message; none where its subscription has ended.

        The first message of another version of its type has other ones: of channels, and requests about that version.
        """
        frames = []
        for each in self._session.answer(message):
            if isinstance(each, TextFrame | BinaryFrame):
                frames.append(_out(each))
            elif not isinstance(each, FoxgloveClose):
                self.ask(each)
        return frames

    def show_late(self, text: str) -> None:
        """A warning, which a later one replaces."""
        self.push(_out(self._session.status(StatusLevel.WARNING, text, "late")))

    def show_drops(self, dropped: dict[str, int]) -> None:
        """A warning for each topic, which a later one replaces."""
        for topic, count in dropped.items():
            text = f"{topic}: {count} messages were dropped so far, as this client is too slow for all that it reads"
            self.push(_out(self._session.status(StatusLevel.WARNING, text, f"dropped {topic}")))

    def _do(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, TextFrame | BinaryFrame):
                self.push(_out(output))
            elif isinstance(output, FoxgloveClose):
                self.end(output.code, output.reason, "message")
            else:
                self.ask(output)


def _out(frame: FoxgloveFrame) -> OutFrame:
    if isinstance(frame, TextFrame):
        return Opcode.TEXT, (frame.data,)
    return Opcode.BINARY, (frame.header, frame.payload)
