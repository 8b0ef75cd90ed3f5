"""A Foxglove client's session with a hub that the test plays."""

from __future__ import annotations

from typing import Any

import msgspec

from rmpa.web.foxglove.channels import ChannelTable
from rmpa.web.foxglove.session import FoxgloveSession
from rmpa.web.hub.frame_writer import Opcode
from rmpa.web.hub.graph import GraphService, GraphTopic
from rmpa.web.hub.node_link import Rights
from tests.web.recorder import Asked, FakeHub, Recorded, record

ALL = Rights(view=True, control=True)
CHATTER = GraphTopic("/chatter", ("std_msgs/String",), ("/talker",), ("/listener",))
SET_BOOL = GraphService("/set_bool", "std_srvs/SetBool", ("/server",))


class Client(Recorded):
    """A session, and what it says: `json` and `binary` since its beginning. `beside` shares that one's table."""

    def __init__(self, rights: Rights = ALL, *, sim_time: bool = False, beside: Client | None = None) -> None:
        hub: Any = FakeHub(sim_time=sim_time) if beside is None else beside.hub
        self.hub: FakeHub = hub
        self.table: ChannelTable = beside.table if beside else ChannelTable(hub, "base", services=rights.control)
        if beside is None:
            record(self.table._client, [])
        self.table.run = "run-1"
        session = FoxgloveSession(hub, rights, "here", self.table)
        super().__init__(session)
        session.opened()

    @property
    def json(self) -> list[dict[str, Any]]:
        return [msgspec.json.decode(parts[0]) for opcode, parts in self.connection.sent if opcode is Opcode.TEXT]

    @property
    def binary(self) -> list[bytes]:
        return [b"".join(parts) for opcode, parts in self.connection.sent if opcode is Opcode.BINARY]

    def send(self, message: dict[str, Any] | bytes) -> list[Asked]:
        return self.send_raw(message if isinstance(message, bytes) else msgspec.json.encode(message).decode())

    def graph(self, *entries: GraphTopic | GraphService) -> None:
        self.hub.graph.show(*entries)

    def of(self, op: str) -> list[dict[str, Any]]:
        return [message for message in self.json if message["op"] == op]

    @property
    def errors(self) -> list[str]:
        return [message["message"] for message in self.of("status") if message["level"] == 2]

    def subscribe(self, channel: int = 1, number: int = 7) -> Asked:
        self.send({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel}]})
        return self.last("subscribe")
