"""One page of the monitor: its messages and the agent's states in; frames, and calls of the hub, out."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import logging
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

import msgspec
from aiohttp import WSCloseCode
from msgspec import Meta

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name
from rmpa.core.timers import TokenBucket
from rmpa.web.hub.connection import Session, decoder_of, ops_of
from rmpa.web.hub.frame_writer import Opcode
from rmpa.web.monitor import limits
from rmpa.web.monitor.driving import TWIST, Command, Driver, Joystick, Stick, type_driven
from rmpa.web.monitor.layers import watch_of
from rmpa.web.monitor.messages import VERSION, Tree, WatchState, difference
from rmpa.web.monitor.publishing import FieldError, PagePublications
from rmpa.web.monitor.questions import QUESTIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Rights
    from rmpa.web.hub.topics import ReceivedMessage
    from rmpa.web.monitor.monitor import Monitor

_log = logging.getLogger(__name__)
Id: TypeAlias = Annotated[int, Meta(gt=0, lt=2**32)]
Kind: TypeAlias = Literal[
    "module", "topic", "service", "node", "resource", "counters", "rates", "diagnostics", "diagnostic"
]
How: TypeAlias = Literal["value", "plot", "image", "map", "tf"]
# Of a joystick: a share of the fastest that is allowed.
Tilt: TypeAlias = Annotated[float, Meta(ge=-1, le=1)]
# What a page may have, as ``hello`` lists it.
RIGHTS: Final = ("view", "control", "drive")
_NO_TOKEN: Final = (
    "this page may not read parameters and recordings",
    "open it with a token: rmpa web --token-file FILE, or --control",
)
_NO_DRIVE: Final = "this page may not drive", "start rmpa web with --drive"
_NO_CONTROL: Final = "this page may only look", "start rmpa web with --control"


class StatePatches:
    """The states of one page: it gets a state, then patches, paced, and only while it acknowledges them.

    A slow browser gets fewer. There is no queue, just the last state that was sent, which pages share.

    Args:
        now: Seconds of the clock of all further calls.
    """

    def __init__(self, now: float) -> None:
        self._state: Tree | None = None
        self._shown: Tree | None = None
        self._looks: tuple[tuple[Kind, str], ...] = ()
        self._number = self._acknowledged = 0
        self._sent = now - limits.PATCH_PERIOD
        self._stale = False

    def update(self, state: Tree) -> None:
        """The newest state, which is never changed after that."""
        self._state, self._stale = state, True

    def look(self, at: tuple[tuple[Kind, str], ...]) -> None:
        """What the page shows: it wants the details of it."""
        self._looks, self._stale = at, True

    def acknowledge(self, number: int) -> None:
        """The page shows that state or patch, and all before it."""
        self._acknowledged = max(self._acknowledged, min(number, self._number))

    @property
    def due(self) -> float | None:
        """When something is to be sent; ``None`` for not before something else happens."""
        unread = self._number - self._acknowledged
        if not self._stale or self._state is None or unread >= limits.UNACKNOWLEDGED_MAX:
            return None
        return self._sent + limits.PATCH_PERIOD

    def take(self, now: float, details: Callable[[str, str], Tree | None]) -> dict[str, Any] | None:
        """The state or patch to send now; ``details`` are of one thing, by kind and name."""
        if self._state is None or self.due is None or now < self.due:
            return None
        self._stale, self._sent = False, now
        found = {f"{kind}:{name}": details(kind, name) for kind, name in self._looks}
        wanted: Tree = {**self._state, "detail": {key: tree for key, tree in found.items() if tree is not None}}
        shown, self._shown = self._shown, wanted
        patch = difference(shown, wanted) if shown is not None else {}
        if shown is not None and not patch:
            return None
        self._number += 1
        news = {"op": "state", "state": wanted} if shown is None else {"op": "patch", "patch": patch}
        return {**news, "n": self._number}


class MonitorSession(Session):
    """One page. Each method ``op_NAME`` is called for a message of it: its keywords are the members.

    Args:
        hub: The hub.
        rights: What the page may do.
        address: The page's, for logs.
        monitor: What all pages share.
        clock: Monotonic seconds; the event loop's unless it is given.
    """

    kind = "monitor"
    frame_max = limits.REQUEST_MAX + 1
    dates_commands = True

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        address: str,
        monitor: Monitor,
        clock: Callable[[], float] | None = None,
    ) -> None:
        # The joystick publishes by the hub; each op checks the page's own right.
        super().__init__(hub, dataclasses.replace(rights, control=rights.control or rights.drive), address)
        self._may = rights
        self._monitor = monitor
        self.clock = clock or asyncio.get_running_loop().time
        self._opened = self._looked = self.clock()
        self._tick = self._opened + limits.TICK_PERIOD
        self._bucket = TokenBucket(limits.REQUEST_RATE, limits.REQUEST_BURST)
        self._patches = StatePatches(self._opened)
        self._watches: dict[int, WatchState] = {}
        self._questions: set[int] = set()
        self._joystick = Joystick()
        self._driver: Driver | None = None
        self._stick: Stick | None = None
        self._publications = PagePublications(self, self.send, self.failed, self.clock)

    def opened(self) -> None:
        """Greet the page, and show it the state."""
        fastest = {"linear": limits.DRIVE_SPEED, "angular": limits.DRIVE_TURN, "steer": limits.DRIVE_STEER}
        fastest["acceleration"] = limits.DRIVE_ACCELERATION
        may = [right for right in RIGHTS if getattr(self._may, right)]
        about = {"agent": self._monitor.module, "period": limits.PATCH_PERIOD, "fastest": fastest, "may": may}
        self.send({"op": "hello", "version": VERSION, "at": self._opened, **about})
        self._monitor.follow(self, self._update)

    def closing(self) -> None:
        """Stop the robot, and all that the page had open."""
        self._monitor.unfollow(self)
        self._stop()
        self._show_stick("")
        self._publications.close()
        self._questions.clear()

    def received_frame(self, data: str | bytes, now: float) -> None:
        """A message of the page."""
        if not self._bucket.take(now):
            text = f"more than {limits.REQUEST_RATE:g} messages a second"
            self.connection.end(WSCloseCode.POLICY_VIOLATION, text, "message_rate")
        elif len(data) > limits.REQUEST_MAX:
            self._malformed(f"{len(data)} exceeds {limits.REQUEST_MAX} bytes of a monitor's request", "message_size")
        else:
            try:
                message = DECODER.decode(data)
            except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
                self._malformed(f"not a monitor's request: {error}")
                return
            fields = msgspec.structs.asdict(message)
            try:
                getattr(self, type(message).__name__)(now, **fields)
            except RmpaError as error:
                self.failed(fields.get("id", 0), error)
            self.handle_timer(now)

    def _malformed(self, text: str, refusal: str = "message") -> None:
        self.connection.end(WSCloseCode.POLICY_VIOLATION, ascii(text)[1:-1][:100], refusal)

    def warn(self, text: str, subject: str) -> None:
        """Nothing: the page is sent the newest messages only."""

    def next_timer(self) -> float | None:
        """When something is due that the page waits for, or the robot must be stopped."""
        dues: list[float | None] = [self._tick, self._patches.due, self._publications.due]
        if self._driver is not None:
            dues.append(self._driver.due)
        if self._stick is not None and (wait := self._stick.due(self)) is not None:
            dues.append(self.clock() + wait)
        if self.connection.unsent == 0:
            dues += [watch.due(0.0) for watch in self._watches.values()]
        elif self._watches:
            dues.append(self._looked + limits.UNSENT_RETRY)
        return min(due for due in dues if due is not None)

    def handle_timer(self, now: float) -> None:
        """Send what is due, and stop a robot that no page commands any more."""
        self._looked = now
        if self._driver is not None and self._driver.due is not None and now >= self._driver.due:
            self._stop()
        with self._turn():
            if self._stick is not None:
                self._stick.handle_timer(self)
            self._publications.handle_timer(now)
            if (news := self._patches.take(now, self._monitor.details)) is not None:
                self.send(news)
            self._flush(now)
            if now >= self._tick:
                self._tick = now + limits.TICK_PERIOD
                if self.connection.unsent == 0:
                    # Scripts do not see WebSocket's pings: a page that misses ticks takes the connection for lost.
                    self.send({"op": "tick", "at": now})

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        """A fault of one page's session must not end the server, nor keep states from other pages."""
        try:
            yield
        except Exception:  # noqa: BLE001 - as it says
            _log.exception("! the session of %s failed", self.name)
            self.connection.end(WSCloseCode.INTERNAL_ERROR, "the server failed; its log says why")
        self.connection.arm()

    def send(self, message: dict[str, Any]) -> None:
        """Send a message to the page."""
        self.connection.push((Opcode.TEXT, (msgspec.json.encode(message),)))

    def failed(self, id_: int, error: RmpaError) -> None:
        """What the page ordered cannot be done: a watch, a question, or (0) neither."""
        remedy = str(getattr(error, "remedy", ""))
        text = str(error).removesuffix(f"; {remedy}") if remedy else str(error)
        field = {"field": error.field} if isinstance(error, FieldError) else {}
        self._refuse(id_, text, remedy, error.code, **field)

    def _refuse(self, id_: int, error: str, remedy: str = "", code: str = "refused", **more: Any) -> None:
        self.send({"op": "failed", "id": id_, "error": error, "remedy": remedy, "code": code, **more})

    def _update(self, state: Tree) -> None:
        self._patches.update(state)
        self.handle_timer(self.clock())

    def op_ack(self, _: float, *, n: int) -> None:
        """The state or patch number ``n`` is shown, and all before it."""
        self._patches.acknowledge(n)

    def op_look(
        self, _: float, *, at: Annotated[tuple[tuple[Kind, str], ...], Meta(max_length=limits.LOOKS_MAX)] = ()
    ) -> None:
        """The page shows these things and wants their details; none of others. Each is ``[kind, name]``."""
        self._patches.look(at)

    def op_watch(
        self,
        _: float,
        *,
        id: Id,  # noqa: A002 - the protocol's word
        topic: str,
        how: How,
        fields: Annotated[tuple[str, ...], Meta(max_length=limits.FIELDS_MAX)] = (),
        rate: Annotated[float, Meta(gt=0, le=limits.WATCH_RATE_MAX)] = 5.0,
        width: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0,
    ) -> None:
        """Messages of a topic: its newest values, lines of a plot, images for a ``width`` in pixels, or layers."""
        if (how == "plot") != bool(fields):
            self._malformed(f"a plot has 1 to {limits.FIELDS_MAX} fields, everything else none")
            return
        _check_topic(topic)
        if id in self._watches:
            raise RemoteProtocolError(f"watch {id} is in use")
        if len(self._watches) >= limits.WATCHES_MAX:
            raise RemoteProtocolError(f"{limits.WATCHES_MAX} topics are watched already; close one first")
        watch = watch_of(id, how, fields, rate, self.hub.values, width)
        self._watches[id] = watch

        def receive(message: ReceivedMessage) -> None:
            with self._turn():
                try:
                    watch.receive(message)
                except RmpaError as error:
                    self._end_watch(id, error)
                self._flush(self.clock())

        def failed(error: RmpaError) -> None:
            with self._turn():
                self._end_watch(id, error)

        try:
            watch.subscription = self.subscribe(topic, None, receive, failed)
        except RmpaError as error:
            self._end_watch(id, error)

    def op_seen(self, _: float, *, ids: Annotated[tuple[Id, ...], Meta(max_length=limits.WATCHES_MAX)]) -> None:
        """An image of each of these watches is drawn."""
        for id_ in ids:
            if (known := self._watches.get(id_)) is not None:
                known.seen()

    def op_unwatch(self, _: float, *, id: Id) -> None:  # noqa: A002
        """No more messages of that watch."""
        self._end_watch(id)

    def _end_watch(self, id_: int, error: RmpaError | None = None) -> None:
        watch = self._watches.pop(id_, None)
        if watch is not None and watch.subscription is not None:
            watch.subscription.close()
        if error is not None:
            self.failed(id_, error)

    def _flush(self, now: float) -> None:
        for id_, watch in [*self._watches.items()] if self.connection.unsent == 0 else ():
            due = watch.due(now)
            if due is None or due > now:
                continue
            try:
                frame = watch.frame(now)
            except RmpaError as error:
                self._end_watch(id_, error)
            else:
                if (beat := watch.beat.news()) is not None:
                    self.send({"op": "beat", "id": id_, **beat})
                if isinstance(frame, bytes):
                    self.connection.push((Opcode.BINARY, (frame,)))
                elif isinstance(frame, dict):
                    self.send(frame)
                else:
                    self._make(id_, watch, frame)

    def _make(self, id_: int, watch: WatchState, make: Callable[[], bytes]) -> None:
        """Make a frame in a thread, and send it unless the watch has ended by then."""
        watch.busy = True

        def done(frame: bytes) -> None:
            watch.busy = False
            if self._watches.get(id_) is watch:
                with self._turn():
                    self.connection.push((Opcode.BINARY, (frame,)))

        self.run(asyncio.to_thread(make), done, functools.partial(self._end_watch, id_))

    def op_ask(self, now: float, *, id: Id, what: str, args: dict[str, Any] = {}, at: float = 0.0) -> None:  # noqa: A002, B006 - copied by msgspec
        """A question or an order that has one answer; ``at`` is as of ``drive``."""
        if what not in QUESTIONS:
            raise RemoteProtocolError(f"there is no question {what[:40]!a}")
        needed = QUESTIONS[what]
        if needed and not getattr(self._may, needed):
            self._refuse(id, *(_NO_TOKEN if needed == "view" else _NO_CONTROL))
        elif needed == "control" and self._is_late(id, now, at):
            pass
        elif id in self._questions or len(self._questions) >= limits.ASKS_MAX:
            self._refuse(id, f"{len(self._questions)} questions wait for an answer already")
        else:
            self._questions.add(id)

            def reply(send: Callable[[Any], None], value: Any) -> None:
                if id in self._questions:
                    self._questions.discard(id)
                    send(value)

            done = functools.partial(reply, lambda value: self.send({"op": "answer", "id": id, "value": value}))
            failed = functools.partial(reply, functools.partial(self.failed, id))
            self.run(self._monitor.answers.answer(what, args), done, failed)

    def _is_late(self, id_: int, now: float, at: float) -> bool:
        """Refuse an order that TCP kept over a cut: it must not act long after the page has given it up."""
        if now - at <= limits.ORDER_AGE:
            return False
        late = min(now - at, now - self._opened)
        text = f"the order may have come {late:.0f} s late, and is not carried out"
        self._refuse(id_, text, "look at what is, and repeat it")
        return True

    def op_publish(
        self,
        now: float,
        *,
        id: Id,  # noqa: A002
        topic: str,
        type: str,  # noqa: A002
        values: dict[str, Any],
        rate: Annotated[float, Meta(ge=0)] = 0.0,
        at: float = 0.0,
    ) -> None:
        """Publish a message of a form: once where ``rate`` is 0, else until ``unpublish``; ``at`` as of ``ask``."""
        if not self._may.control:
            self._refuse(id, *_NO_CONTROL)
        elif not self._is_late(id, now, at):
            _check_topic(topic)
            self._publications.begin(id, topic, type, values, rate)

    def op_publishing(self, now: float, *, id: Id) -> None:  # noqa: A002
        """The page is there, and what it publishes goes on; repeated each second."""
        self._publications.renew(id, now)

    def op_unpublish(self, _: float, *, id: Id) -> None:  # noqa: A002
        """Publish it no more."""
        self._publications.end(id)

    def op_stick(
        self,
        _: float,
        *,
        topic: str,
        want: Literal["look", "take", "over", "leave", "stop"],
        type: str = TWIST,  # noqa: A002 - the protocol's word
    ) -> None:
        """The page shows the joystick of a topic (``""``: none), and wants to know the holder, or to be it or not.

        ``stop`` ends the hold of any page and stops the robot; every page may.
        """
        if topic:
            _check_topic(topic)
        self._show_stick(topic)
        if (stick := self._stick) is None:
            return
        if want == "stop":
            stick.stop(self.address)
            if self._may.drive and (driver := self._driver_of(topic, type, stops=True)) is not None:
                driver.stop()
        elif want == "leave":
            stick.leave(self)
        elif want != "look":
            if not self._may.drive:
                self._refuse(0, *_NO_DRIVE)
                return
            stick.take(self, self.address, over=want == "over")

    def _show_stick(self, topic: str) -> None:
        stick = self._stick
        if stick is not None and stick.topic != topic:
            self._stick = None
            stick.hide(self)
        if topic and self._stick is None:
            self._stick = self._monitor.sticks.show(topic, self, self._stick_changed, drives=self._may.drive)
            self._tell_stick(self._stick)

    def _stick_changed(self, had: bool) -> None:
        stick = self._stick
        if stick is None:
            return
        with self._turn():
            if had and stick.holder is not self:
                self._joystick.release()
                self._stop()
                if stick.hold.ended:
                    self._refuse(0, stick.hold.ended, "the robot does not obey this page any more")
            self._tell_stick(stick)

    def _tell_stick(self, stick: Stick) -> None:
        hold = stick.hold
        holder = {"by": hold.by, "module": hold.module, "since": hold.since} if hold.by else None
        about = {"holder": holder, "mine": stick.holder is self, "problem": stick.problem}
        self.send({"op": "stick", "topic": stick.topic, **about})

    def op_drive(
        self,
        now: float,
        *,
        topic: str,
        linear: Tilt,
        angular: Tilt,
        hold: int,
        n: int,
        at: float,
        type: str = TWIST,  # noqa: A002 - the protocol's word
        side: Tilt = 0.0,
        ramp: Annotated[float, Meta(gt=0, le=limits.DRIVE_ACCELERATION)] = limits.DRIVE_ACCELERATION,
        axes: Annotated[tuple[Tilt, ...], Meta(max_length=limits.AXES_MAX)] = (),
        buttons: Annotated[tuple[bool, ...], Meta(max_length=limits.BUTTONS_MAX)] = (),
    ) -> None:
        """A joystick; repeated every 0.1 s while it is held.

        ``hold`` numbers the times that the stick was taken, and ``n`` the commands, both rising; ``at`` is when it
        was made, by the server's clock as the page knows it (``Joystick``). ``ramp`` is in m/s²; ``axes`` and
        ``buttons`` are a gamepad's, for sensor_msgs/Joy.
        """
        if not self._may.drive:
            self._refuse(0, *_NO_DRIVE)
            return
        _check_topic(topic)
        joystick = self._joystick
        if not joystick.takes(hold, n, at, now):
            if joystick.is_new_late(at, now):
                late = f"commands reach the server {now - at:.1f} s late, and are dropped"
                self._refuse(0, late, f"above {limits.DRIVE_TIMEOUT:g} s the robot stays where it is", hold=hold)
            return
        if self._driver is not None and self._driver.topic != topic:
            self._stop()
        self._show_stick(topic)
        assert self._stick is not None  # noqa: S101 - shown just now
        try:
            self._stick.take(self, self.address)
        except RmpaError:
            joystick.release(hold)  # said once
            raise
        if (driver := self._driver_of(topic, type)) is None:
            joystick.release(hold)
        elif (sent := driver.command(Command(linear, side, angular, axes, buttons), ramp, now)) is not None:
            self.send({"op": "driven", "linear": sent.linear, "side": sent.side, "angular": sent.angular})

    def op_release(self, _: float, *, hold: int) -> None:
        """The joystick is let go: the robot is stopped at once, and nothing more of that hold drives it."""
        self._joystick.release(hold)
        self._stop()

    def _stop(self) -> None:
        if self._driver is not None and self._driver.due is not None:
            self._driver.stop()

    def _end_driver(self) -> None:
        self._stop()
        if self._driver is not None:
            self._driver.close()
        self._driver = None

    def _driver_of(self, topic: str, wanted: str, *, stops: bool = False) -> Driver | None:
        """What publishes a topic for this page; ``None``: the page is told why it cannot be driven.

        Args:
            topic: What is driven.
            wanted: The type that the page names.
            stops: Whether it is to stop, in whatever type the topic has.
        """

        def failed(error: RmpaError) -> None:
            self._end_driver()
            self.failed(0, error)

        driver = self._driver
        try:
            type_ = type_driven(self.hub.graph, topic, wanted, stops=stops)
            if driver is None or (driver.topic, driver.type) != (topic, type_):
                self._end_driver()
                self._driver = Driver(self, topic, type_, failed)
        except RmpaError as error:
            failed(error)
        return self._driver


def _check_topic(topic: str) -> None:
    """A user may have typed it, and a master accepts names that are none: it is no fault of the page.

    Raises:
        RemoteProtocolError: It is not a topic's name.
    """
    if not is_global_name(topic):
        raise RemoteProtocolError(f"{topic[:80]!a} is not a topic's name; write it as /name")


# The members of each message of a page (docs/design/monitor-protocol.md).
OPS: Final = ops_of(MonitorSession, str, tagged=True)
DECODER: Final = decoder_of(OPS)
