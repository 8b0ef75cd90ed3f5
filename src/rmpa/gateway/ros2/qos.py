"""The QoS of a ROS 2 endpoint, and its text in a liveliness token.

The text is ``reliability:durability:history,depth:deadline:lifespan:liveliness,lease``, where a duration is
``seconds,nanoseconds``. A value that is rmw's default is left out, but for the depth of *keep last*: a publisher
with the default QoS has ``::,10:,:,:,,``, a latched one ``:1:,1:,:,:,,``. The numbers are those of
rmw/types.h.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, TypeVar

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits

INFINITE: Final = 2**63 - 1
"""A duration that never ends, in nanoseconds: the default of all durations (RMW_DURATION_INFINITE)."""
_NANO: Final = 1_000_000_000
_PARTS: Final = 6
DEFAULT_DEPTH: Final = 10
"""Messages that *keep last* keeps by default."""


class Ros2Reliability(IntEnum):
    """Whether a message that is lost on the way is sent again."""

    RELIABLE = 1
    BEST_EFFORT = 2


class Ros2Durability(IntEnum):
    """Whether a later subscriber gets earlier messages; ``TRANSIENT_LOCAL`` is what ROS 1 calls latched."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Ros2History(IntEnum):
    """How many messages an endpoint keeps."""

    KEEP_LAST = 1
    KEEP_ALL = 2


class Ros2Liveliness(IntEnum):
    """How a publisher shows that it is alive."""

    AUTOMATIC = 1
    MANUAL_BY_NODE = 2
    MANUAL_BY_TOPIC = 3


_Kind = TypeVar("_Kind", bound=IntEnum)


@dataclass(frozen=True, slots=True)
class Ros2Qos:
    """The QoS of one endpoint; the defaults are rmw's for topics.

    Args:
        reliability: See :class:`Ros2Reliability`.
        durability: See :class:`Ros2Durability`.
        history: See :class:`Ros2History`.
        depth: Messages that *keep last* keeps.
        deadline: The longest time between two messages, in nanoseconds.
        lifespan: How long a message is of use, in nanoseconds.
        liveliness: See :class:`Ros2Liveliness`.
        lease: Silence after which a publisher counts as dead, in nanoseconds.
    """

    reliability: Ros2Reliability = Ros2Reliability.RELIABLE
    durability: Ros2Durability = Ros2Durability.VOLATILE
    history: Ros2History = Ros2History.KEEP_LAST
    depth: int = DEFAULT_DEPTH
    deadline: int = INFINITE
    lifespan: int = INFINITE
    liveliness: Ros2Liveliness = Ros2Liveliness.AUTOMATIC
    lease: int = INFINITE

    @property
    def latched(self) -> bool:
        """Whether a later subscriber gets the last messages, as of a latched publisher of ROS 1."""
        return self.durability is Ros2Durability.TRANSIENT_LOCAL

    def serialize(self) -> str:
        """The text in a liveliness token."""
        default = Ros2Qos()
        kinds = (
            ("" if value is usual else str(int(value)))
            for value, usual in (
                (self.reliability, default.reliability),
                (self.durability, default.durability),
                (self.history, default.history),
                (self.liveliness, default.liveliness),
            )
        )
        reliability, durability, history, liveliness = kinds
        times = f"{_duration(self.deadline)}:{_duration(self.lifespan)}:{liveliness},{_duration(self.lease)}"
        return f"{reliability}:{durability}:{history},{self.depth}:{times}"

    @classmethod
    def parse(cls, text: str) -> Ros2Qos:
        """Read the text of a token. A value that this version does not know counts as the default.

        Raises:
            RemoteProtocolError: The text has another form.
        """
        parts = text.split(":")
        if len(parts) < _PARTS:
            raise RemoteProtocolError(f"the QoS {text[:80]!r} has {len(parts)} parts instead of {_PARTS}")
        default = cls()
        history, _, depth = parts[2].partition(",")
        liveliness, _, lease = parts[5].partition(",")
        return cls(
            _kind(Ros2Reliability, parts[0], default.reliability),
            _kind(Ros2Durability, parts[1], default.durability),
            _kind(Ros2History, history, default.history),
            _number(depth, DEFAULT_DEPTH),
            _nanoseconds(parts[3]),
            _nanoseconds(parts[4]),
            _kind(Ros2Liveliness, liveliness, default.liveliness),
            _nanoseconds(lease),
        )


def _duration(nanoseconds: int) -> str:
    return "," if nanoseconds == INFINITE else "{},{}".format(*divmod(nanoseconds, _NANO))


def _nanoseconds(text: str) -> int:
    seconds, _, nanoseconds = text.partition(",")
    if not seconds and not nanoseconds:
        return INFINITE
    return min(_number(seconds, 0) * _NANO + _number(nanoseconds, 0), INFINITE)


def _number(text: str, default: int) -> int:
    if not text:
        return default
    # int() also takes "+1", "1_0" and digits of other scripts.
    if not (text.isascii() and text.isdigit() and len(text) <= len(str(limits.QOS_NUMBER_MAX))):
        raise RemoteProtocolError(f"{text[:40]!r} in a QoS is not a number")
    return min(int(text), limits.QOS_NUMBER_MAX)


def _kind(kind: type[_Kind], text: str, default: _Kind) -> _Kind:
    number = _number(text, int(default))
    try:
        return kind(number)
    except ValueError:
        return default  # 0 is the system's default, and rmw has more kinds than these
