"""Who has the stick of a driven topic: one page of one module at a time, known to all that show its joystick.

Servers tell each other by the topic ``TOPIC/holder``, so that it is renamed, permitted and recorded as ``TOPIC`` is.
A ``Hold`` is said anew every ``limits.STICK_RENEW`` while it lasts; one that is not heard for
``limits.STICK_EXPIRY`` has ended. Each taking has a higher ``turn`` than what was known, and of two at one moment the
higher ``id`` holds: all servers decide alike, in whatever order they hear of it.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.topics import ClientPublication, ClientSubscription, ReceivedMessage

SUFFIX: Final = "/holder"
_TYPE: Final = "std_msgs/String"


class Hold(msgspec.Struct, frozen=True):
    """One taking of a stick, as the servers tell it: JSON in a std_msgs/String.

    Attributes:
        turn: Numbers the takings.
        id: Of this one.
        by: The address of the page; empty: the stick is free.
        module: The page's module; of a free stick the one that has ended the hold.
        since: When it was taken, in seconds since the epoch.
        ended: Why the hold before ended, where another page has ended it.
    """

    turn: int = 0
    id: str = ""
    by: str = ""
    module: str = ""
    since: float = 0.0
    ended: str = ""

    @property
    def who(self) -> str:
        """The page, for people."""
        return f"the page of {self.by} at {self.module}"


class Stick:
    """The stick of one topic, of all pages of this server.

    Args:
        hub: Publishes and subscribes.
        topic: What is driven.
        module: The name of this module.
        clock: Monotonic seconds.

    Attributes:
        hold: The one that counts.
        holder: The page that has it; ``None``: it is free, or of another server.
        problem: Why other modules are not told; empty: they are.
    """

    def __init__(self, hub: Hub, topic: str, module: str, clock: Callable[[], float]) -> None:
        self.topic, self.hold, self.problem = topic, Hold(), ""
        self.holder: object | None = None
        self.pages: dict[object, Callable[[], None]] = {}
        self._hub = hub
        self._module = module
        self._clock = clock
        self._heard = 0.0
        self._publication: ClientPublication | None = None
        self._subscription: ClientSubscription | None = None
        try:
            self._subscription = hub.topics.subscribe(topic + SUFFIX, _TYPE, self._receive, self._failed)
        except RmpaError as error:
            self._failed(error)

    def advertise(self) -> None:
        """Connect to the other servers, so that they hear the next word at once."""
        if self._publication is None and not self.problem:
            name = self.topic + SUFFIX
            try:
                self._publication = self._hub.topics.advertise(name, _TYPE, self._failed, latch=True)
            except RmpaError as error:
                self._failed(error)

    def close(self) -> None:
        """No page shows it any more."""
        for each in (self._subscription, self._publication):
            if each is not None:
                each.close()

    def take(self, page: object, by: str, *, over: bool = False) -> None:
        """Give it to a page.

        Args:
            page: The page.
            by: Its address.
            over: Whether to take it from the page that has it.

        Raises:
            PeerRefused: Another page has it.
        """
        if self.holder is page:
            return
        if self.hold.by and not over:
            raise PeerRefused("the stick", f"{self.hold.who} has it", "let that page go, or take it over")
        made = self._next(by)
        ended = f"{made.who} has taken the stick over" if self.hold.by else ""
        self._say(msgspec.structs.replace(made, ended=ended), page)

    def leave(self, page: object) -> None:
        """A page lets it go."""
        if self.holder is page:
            self._say(msgspec.structs.replace(self.hold, by="", ended=""), None)

    def stop(self, by: str) -> None:
        """End the hold, whichever page has it."""
        made = self._next(by)
        self._say(msgspec.structs.replace(made, by="", ended=f"{made.who} has stopped the robot"), None)

    def handle_timer(self, page: object) -> None:
        """Say it anew if the page has it; end one that was not heard for long."""
        silent = self._clock() - self._heard
        if self.holder is page and silent >= limits.STICK_RENEW:
            self._say(self.hold, page, told=False)
        elif self.holder is None and self.hold.by and silent >= limits.STICK_EXPIRY:
            self._set(Hold(self.hold.turn), None)  # without its id: should it be heard again, it holds again

    def due(self, page: object) -> float | None:
        """In how many seconds ``handle_timer`` is to be called for a page."""
        if not self.hold.by or self.holder not in (None, page):
            return None
        after = limits.STICK_EXPIRY if self.holder is None else limits.STICK_RENEW
        return max(0.0, self._heard + after - self._clock())

    def received(self, hold: Hold) -> None:
        """What another server says, or this one has said."""
        ours, theirs = (self.hold.turn, self.hold.id), (hold.turn, hold.id)
        if theirs == ours:
            if self.hold.by and not hold.by:
                self._set(hold, None)
            elif self.holder is None:
                self._heard = self._clock()
        elif theirs > ours or (not self.hold.by and self._clock() - self._heard >= limits.STICK_EXPIRY):
            self._set(hold, None)

    def _next(self, by: str) -> Hold:
        return Hold(self.hold.turn + 1, os.urandom(8).hex(), by, self._module, time.time())

    def _say(self, hold: Hold, holder: object | None, *, told: bool = True) -> None:
        if told:
            self._set(hold, holder)
        self._heard = self._clock()
        self.advertise()
        if self._publication is not None:
            text = msgspec.json.encode(hold)
            self._publication.publish(len(text).to_bytes(4, "little") + text)

    def _set(self, hold: Hold, holder: object | None) -> None:
        self.hold, self.holder, self._heard = hold, holder, self._clock()
        for changed in [*self.pages.values()]:
            changed()

    def _receive(self, message: ReceivedMessage) -> None:
        try:
            hold = msgspec.json.decode(bytes(message.payload[4:]), type=Hold)
        except (msgspec.DecodeError, UnicodeError):
            return  # of another program
        self.received(hold)

    def _failed(self, error: RmpaError) -> None:
        self.problem = f"other modules do not see who drives: {error}"
        self._publication = None
        for changed in [*self.pages.values()]:
            changed()


class Sticks:
    """The sticks that pages of this server show.

    Args:
        hub: For each stick.
        module: The name of this module.
        clock: Monotonic seconds.
    """

    def __init__(self, hub: Hub, module: Callable[[], str], clock: Callable[[], float] = time.monotonic) -> None:
        self._hub = hub
        self._module = module
        self._clock = clock
        self._sticks: dict[str, Stick] = {}

    def show(self, topic: str, page: object, changed: Callable[[], None], *, drives: bool) -> Stick:
        """The stick of a topic.

        Args:
            topic: What is driven.
            page: Shows it.
            changed: Called when it has another holder.
            drives: Whether the page may take it.
        """
        stick = self._sticks.get(topic)
        if stick is None:
            stick = self._sticks[topic] = Stick(self._hub, topic, self._module(), self._clock)
        stick.pages[page] = changed
        if drives:
            stick.advertise()
        return stick

    def hide(self, stick: Stick, page: object) -> None:
        """The page does not show it any more."""
        del stick.pages[page]
        stick.leave(page)
        if not stick.pages:
            stick.close()
            del self._sticks[stick.topic]
