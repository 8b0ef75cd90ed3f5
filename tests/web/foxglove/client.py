"""A Foxglove client's session with a hub that the test plays."""

from __future__ import annotations

from typing import Any

import msgspec

from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.session import FoxgloveClose, FoxgloveSession, Output
from rmpa.web.hub import requests
from rmpa.web.hub.node_link import Rights
from rmpa.web.hub.requests import GraphService, GraphTopic

ALL = Rights(view=True, control=True)
CHATTER = GraphTopic("/chatter", ("std_msgs/String",), ("/talker",), ("/listener",))
SET_BOOL = GraphService("/set_bool", "std_srvs/SetBool", ("/server",))


class Client:
    """A session and its hub: describes every type that rmpa brings, and keeps what the session says."""

    def __init__(self, rights: Rights = ALL, *, sim_time: bool = False, knows: bool = True) -> None:
        self.session = FoxgloveSession("base", "run-1", rights, sim_time=sim_time)
        self.knows = knows
        self.json: list[dict[str, Any]] = []
        self.frames: list[protocol.BinaryFrame] = []
        self.asked: list[requests.HubRequest] = []
        self.closed: list[FoxgloveClose] = []
        self.do(self.session.open())

    def do(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, protocol.TextFrame):
                self.json.append(msgspec.json.decode(output.data))
            elif isinstance(output, protocol.BinaryFrame):
                self.frames.append(output)
            elif isinstance(output, FoxgloveClose):
                self.closed.append(output)
            else:
                self.asked.append(output)
                if isinstance(output, requests.DescribeType) and self.knows:
                    self.hub(described(output))

    def hub(self, answer: requests.Answer) -> None:
        self.do(self.session.answer(answer))

    def send(self, message: dict[str, Any] | bytes, now: float = 0.0) -> None:
        data = message if isinstance(message, bytes) else msgspec.json.encode(message).decode()
        self.do(self.session.receive(data, now))

    def graph(self, *entries: GraphTopic | GraphService) -> None:
        topics = tuple(each for each in entries if isinstance(each, GraphTopic))
        services = tuple(each for each in entries if isinstance(each, GraphService))
        handle = next(each.handle for each in self.asked if isinstance(each, requests.FollowGraph))
        self.hub(requests.GraphChanged(handle, topics, services))

    def of(self, op: str) -> list[dict[str, Any]]:
        return [message for message in self.json if message["op"] == op]

    def last(self, kind: type[Any]) -> Any:
        return next(each for each in reversed(self.asked) if isinstance(each, kind))

    @property
    def errors(self) -> list[str]:
        return [message["message"] for message in self.of("status") if message["level"] == 2]

    def subscribe(self, channel: int = 1, number: int = 7) -> int:
        self.send({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel}]})
        handle: int = self.last(requests.Subscribe).handle
        return handle


def described(asked: requests.DescribeType) -> requests.Answer:
    if asked.service:
        service = ServiceType(asked.type)
        return requests.Described(asked.handle, asked.type, service.request.definition, service.response.definition)
    kind = MessageType(asked.type)
    if asked.md5sum and asked.md5sum != kind.md5sum:
        text = f"string data # as {asked.md5sum} has it"
        return requests.Described(asked.handle, asked.type, text, md5sum=asked.md5sum)
    return requests.Described(asked.handle, asked.type, kind.definition, md5sum=kind.md5sum)


def message(
    subscription: int, topic: str, payload: bytes, stamp: int = 5, md5sum: str = ""
) -> requests.ReceivedMessage:
    return requests.ReceivedMessage(subscription, topic, "std_msgs/String", memoryview(payload), stamp, md5sum=md5sum)
