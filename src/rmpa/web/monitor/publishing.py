"""What one page publishes, once or at a rate while the page renews it."""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.ros.types.values import CODES, Written, WrongValueError
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.connection import Session
    from rmpa.web.hub.topics import ClientPublication

_WORDS: Final = ("nan", "inf", "+inf", "-inf")


class FieldError(RmpaError):
    """A value of a form does not fit its field; ``field`` is the path, as ``pose.position.x`` or ``axes[2]``."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}" if field else problem, code="invalid-message")
        self.field = field


class _TypedMessage(Written):
    """A message of a form. JSON has no NaN, and its numbers no 64 bits: both come as text."""

    size_max = limits.PUBLISHED_BYTES

    def number(self, kind: str, value: Any) -> float:
        if isinstance(value, str) and len(value) < 24:
            text = value.strip().lower()
            if CODES[kind] in "fd" and text in _WORDS:
                return float(text)
            if CODES[kind] in "qQ" and text.removeprefix("-").isdecimal():
                return int(text)
        return super().number(kind, value)


def message_of(codec: MessageCodec, values: dict[str, Any], now_ns: int) -> bytes:
    """The bytes of a form's values; what is not given is zero, and the stamp of a header the present time.

    Raises:
        FieldError: A value does not fit; it names the field.
    """
    written = _TypedMessage(now_ns)
    try:
        codec.fill(values, written)
    except WrongValueError as error:
        path = ".".join(reversed(error.path)).replace(".[", "[")
        raise FieldError(path, str(error.args[0])) from None
    return written.payload


@dataclass(slots=True, eq=False)
class _Repeated:
    """A topic that is published at a rate. Its values are written anew each time: ``"now"`` is the time of each.

    Attributes:
        next: When the next message is due.
        renewed: When the page last said that it is there.
        count: Messages so far.
    """

    publication: ClientPublication
    codec: MessageCodec
    values: dict[str, Any]
    period: float
    next: float
    renewed: float
    count: int = 0


class PagePublications:
    """The topics of one page.

    Args:
        client: Publishes them.
        send: Sends a message to the page.
        failed: Tells the page why an order has failed.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        client: Session,
        send: Callable[[dict[str, Any]], None],
        failed: Callable[[int, RmpaError], None],
        clock: Callable[[], float],
    ) -> None:
        self._client = client
        self._send = send
        self._failed = failed
        self._clock = clock
        # ``None`` while its type is looked for.
        self._repeated: dict[int, _Repeated | None] = {}

    @property
    def due(self) -> float | None:
        """When something is to be done."""
        there = [each for each in self._repeated.values() if each is not None]
        return min((min(each.next, each.renewed + limits.PUBLISH_RENEW) for each in there), default=None)

    def begin(self, id_: int, topic: str, type_: str, values: dict[str, Any], rate: float) -> None:
        """Publish once where ``rate`` is 0, else at once and then so often a second."""
        if id_ in self._repeated or rate > limits.PUBLISHED_RATE or len(self._repeated) >= limits.PUBLISHED_MAX:
            bounds = f"{limits.PUBLISHED_RATE:g} messages a second, of {limits.PUBLISHED_MAX} topics"
            raise RmpaError(f"{topic} is not published: a page publishes at most {bounds}")
        self._repeated[id_] = None

        def found(kind: MessageType) -> None:
            if id_ not in self._repeated:
                return  # the page has ended it
            try:
                codec = codec_for(kind)
                message_of(codec, values, time.time_ns())
                made = self._client.advertise(topic, type_, functools.partial(self._ended, id_))
            except RmpaError as error:
                self._ended(id_, error)
                return
            now = self._clock()
            each = _Repeated(made, codec, values, 1 / rate if rate else 0.0, now, now)
            self._publish(id_, each, now)
            if rate and id_ in self._repeated:
                self._repeated[id_] = each
            else:
                self.end(id_)
                made.close()
            self._client.connection.arm()

        self._client.run(self._client.hub.types.find_message(type_), found, functools.partial(self._ended, id_))

    def renew(self, id_: int, now: float) -> None:
        """The page is there, and is told how many messages were published."""
        if (each := self._repeated.get(id_)) is not None:
            each.renewed = now
            self._send({"op": "published", "id": id_, "n": each.count})

    def end(self, id_: int) -> None:
        """Publish it no more."""
        if (each := self._repeated.pop(id_, None)) is not None:
            each.publication.close()

    def close(self) -> None:
        """The page has gone."""
        for id_ in [*self._repeated]:
            self.end(id_)

    def handle_timer(self, now: float) -> None:
        """Publish what is due, and end what the page does not renew."""
        for id_, each in [*self._repeated.items()]:
            if each is None:
                continue
            if now >= each.renewed + limits.PUBLISH_RENEW:
                problem = f"{each.publication.topic} is published no more: the page was silent or hidden"
                self._ended(id_, RmpaError(f"{problem} for {limits.PUBLISH_RENEW:g} s"))
            elif now >= each.next:
                self._publish(id_, each, now)

    def _publish(self, id_: int, each: _Repeated, now: float) -> None:
        try:
            each.publication.publish(message_of(each.codec, each.values, time.time_ns()))
        except RmpaError as error:
            self._ended(id_, error)
            return
        each.count += 1
        each.next = max(each.next + each.period, now)  # after a pause the missed ones are left out
        if each.count == 1:
            self._send({"op": "published", "id": id_, "n": 1})

    def _ended(self, id_: int, error: RmpaError) -> None:
        self.end(id_)
        self._failed(id_, error)
