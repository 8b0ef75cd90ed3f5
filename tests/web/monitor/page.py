"""The other end of the monitor's WebSocket, in Python: what the pages' script does."""

from __future__ import annotations

import asyncio
import itertools
import json
import time
from collections.abc import Callable
from typing import Any

import aiohttp

from tests.waiting import DEADLINE
from tests.web.monitor.patches import apply


class Page:
    """It keeps the state, and acknowledges each patch; it asks, and drives.

    Attributes:
        state: The newest.
        hello: The first message.
        messages: What came and was not taken yet.
    """

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.state: Any = {}
        self.hello: dict[str, Any] = {}
        self.messages: list[dict[str, Any]] = []
        self._commands, self._questions = itertools.count(1), itertools.count(1)

    async def send(self, op: str, **values: Any) -> None:
        """Send a message."""
        await self.socket.send_json({"op": op, **values})

    async def drive(self, linear: float, angular: float = 0.0, topic: str = "/cmd_vel") -> None:
        """A command of the joystick, made now: both ends have one clock here."""
        made = {"hold": 1, "n": next(self._commands), "at": time.monotonic()}
        await self.send("drive", topic=topic, linear=linear, angular=angular, **made)

    async def read(self) -> None:
        """Take the next message."""
        message = await self.socket.receive()
        assert message.type is aiohttp.WSMsgType.TEXT, message
        values = json.loads(message.data)
        match values["op"]:
            case "hello":
                self.hello = values
            case "state":
                self.state = values["state"]
            case "patch":
                self.state = apply(self.state, values["patch"])
            case _:
                self.messages.append(values)
                return
        if "n" in values:
            await self.send("ack", n=values["n"])

    async def sees(self, condition: Any) -> None:
        """Read until the condition holds."""
        async with asyncio.timeout(DEADLINE):
            while not condition():
                await self.read()

    async def next(self, op: str, **wanted: Any) -> dict[str, Any]:
        """The first message of this op with these members; it is taken out."""

        def found() -> list[dict[str, Any]]:
            return [each for each in self.messages if each["op"] == op and wanted.items() <= each.items()]

        await self.sees(found)
        first = found()[0]
        self.messages.remove(first)
        return first

    async def ask(self, what: str, **args: Any) -> Any:
        """The answer's value, or the text of the error."""
        number = next(self._questions)
        await self.send("ask", id=number, what=what, args=args, at=time.monotonic())
        await self.sees(lambda: any(each.get("id") == number for each in self.messages))
        [answer] = [each for each in self.messages if each.get("id") == number]
        self.messages.remove(answer)
        return answer["value"] if answer["op"] == "answer" else answer["error"]

    async def answered(self, what: str, fits: Callable[[Any], bool] = lambda _: True, **args: Any) -> Any:
        """The answer's value, asked again until it fits: what it is about may not be there yet."""
        async with asyncio.timeout(DEADLINE):
            while isinstance(value := await self.ask(what, **args), str) or not fits(value):
                await asyncio.sleep(0.05)
        return value
