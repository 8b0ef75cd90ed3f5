"""One page of the monitor: its session, and what the session asks of the hub, the agent and the robot."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import struct
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.web.gateways.connection import ClientConnection
from rmpa.web.gateways.websocket_frames import Opcode
from rmpa.web.hub.requests import AdvertiseTopic, Failed, PublishMessage, ReceivedMessage, UnadvertiseTopic
from rmpa.web.monitor.session import FollowLog, MonitorClose, MonitorSession, Question, Speed

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.web.gateways.connection import OutFrame
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import Answer
    from rmpa.web.hub.rights import Rights
    from rmpa.web.monitor.io.monitor import Monitor
    from rmpa.web.monitor.patch import Tree
    from rmpa.web.monitor.session import Output

_log = logging.getLogger(__name__)
_TWIST: Final = "geometry_msgs/Twist"
_SPEEDS: Final = struct.Struct("<6d")
"""A geometry_msgs/Twist: linear x, y, z in m/s, then angular x, y, z in rad/s."""


_INTERNAL_ERROR: Final = 1011
"""A WebSocket's close code, RFC 6455, section 7.4.1."""


class MonitorConnection(ClientConnection):
    """One page; the arguments are those of ``ClientConnection``.

    Args:
        monitor: What all pages share.
    """

    kind = "monitor"
    dates_commands = True
    timer_waits = False  # the robot is stopped in time, whatever waits for the page

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        monitor: Monitor,
    ) -> None:
        # The joystick publishes by the hub, whatever else the page may publish: nothing.
        own = dataclasses.replace(rights, control=rights.drive)
        super().__init__(hub, own, priority, address)
        self._monitor = monitor
        self._session = MonitorSession(
            monitor.mesh.details, monitor.values.of, rights, self._loop.time(), lambda: self.unsent
        )
        self._handles = itertools.count(-1, -1)
        self._driven: dict[str, int] = {}
        """The handle of each topic that is published; below zero, as pages number their watches from 1."""
        self._asking: set[asyncio.Task[None]] = set()

    def opened(self) -> None:
        """Greet the page, and show it the state."""
        self._act(self._session.open(self._monitor.mesh.agent))
        self._monitor.mesh.follow(self, self._show)

    def closing(self) -> None:
        """Stop the robot, and all that the page had open."""
        self._monitor.mesh.unfollow(self)
        self._monitor.log.unfollow(self)
        for task in self._asking:
            task.cancel()
        self._act(self._session.close())

    def received_frame(self, data: str | bytes) -> None:
        """A message of the page."""
        self._act(self._session.receive(data, self._loop.time()))

    def receive(self, answer: Answer) -> None:
        """Take an answer of the hub; the session itself keeps only the newest message of a watch."""
        if isinstance(answer, ReceivedMessage):
            self._act(self._session.receive_message(answer, self._loop.time()))
        else:
            self.answered(answer)

    def answered(self, answer: Answer) -> None:
        """A subscription or the joystick's publisher was refused."""
        if not isinstance(answer, Failed):
            return
        if answer.handle in self._driven.values():
            self._driven = {topic: handle for topic, handle in self._driven.items() if handle != answer.handle}
            self._act(self._session.failed(answer.error, answer.remedy))
        else:
            self._act(self._session.end_watch(answer.handle, answer.error, answer.remedy))

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:  # noqa: ARG002
        """Nothing: ``receive`` queues no message of the hub."""
        return ()

    def show_drops(self, dropped: dict[str, int]) -> None:
        """Nothing: the page is sent the newest message only."""

    def next_timer(self) -> float | None:
        """The session's."""
        return self._session.next_timer()

    def handle_timer(self) -> None:
        """Do what is due."""
        self._act(self._session.handle_timer(self._loop.time()))

    def _show(self, state: Tree) -> None:
        self._act(self._session.update(state, self._loop.time()))

    def _act(self, outputs: Iterator[Output]) -> None:
        # What is done here may have the hub deliver at once, which comes back to the session: it must be done first.
        # Of a session that fails, what it said before is done all the same: that may be the robot's stop.
        said: list[Output] = []
        try:
            for output in outputs:
                said.append(output)  # noqa: PERF402 - extend() would lose what came before an error
        except Exception:  # noqa: BLE001 - a fault of one page's session must not end the server
            _log.exception("! the session of %s failed", self.client.name)
            self.end(_INTERNAL_ERROR, "the server failed; its log says why")
        for output in said:
            match output:
                case str():
                    self.push((Opcode.TEXT, (output.encode(),)))
                case bytes():
                    self.push((Opcode.BINARY, (output,)))
                case Question():
                    self._ask(output)
                case Speed():
                    self._drive(output)
                case FollowLog(on=True):
                    self._follow_log()
                case FollowLog():
                    self._monitor.log.unfollow(self)
                case MonitorClose():
                    self.end(output.code, output.reason, output.refusal)
                case _:
                    self.ask(output)
        self.arm()

    def _follow_log(self) -> None:
        log = self._monitor.log
        if kept := log.follow(self, lambda lines: self._act(self._session.log(lines))):
            self._act(self._session.log(kept, kept=True))
        if log.refused is not None:
            self._act(self._session.failed(str(log.refused)))

    def _ask(self, question: Question) -> None:
        async def answer() -> None:
            try:
                value = await self._monitor.answers.answer(question)
            except RmpaError as error:
                failed = Failed.of(0, error)
                self._act(self._session.refuse(question.id, failed.error, failed.remedy))
            except Exception:  # noqa: BLE001 - a task's top
                _log.exception("! the question %s of %s failed", question.what, self.client.name)
                self._act(self._session.refuse(question.id, "the web server failed; its log says why"))
            else:
                self._act(self._session.answer(question.id, value))

        task = self._loop.create_task(answer(), name=f"question of {self.client.name}")
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    def _drive(self, speed: Speed) -> None:
        if speed.topic not in self._driven:
            for handle in self._driven.values():
                self.ask(UnadvertiseTopic(handle))
            self._driven = {speed.topic: next(self._handles)}
            self.ask(AdvertiseTopic(self._driven[speed.topic], speed.topic, _TWIST))
        if speed.topic in self._driven:  # it was not refused at once
            handle = self._driven[speed.topic]
            self.ask(PublishMessage(handle, _SPEEDS.pack(speed.linear, 0, 0, 0, 0, speed.angular)))
