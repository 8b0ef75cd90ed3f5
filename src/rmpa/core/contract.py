"""Contracts: the QoS of a topic in ROS 2's terms, and the rules of ``rmpa.toml`` that set it.

Both ends of a route have rules; ``combine`` of both contracts holds for the route: see docs/guides/contracts.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

from msgspec import UNSET, Meta, UnsetType

from rmpa.core import limits
from rmpa.core.identity import matches

if TYPE_CHECKING:
    from collections.abc import Mapping

# (topic, type) pairs whose contract is cached; the oldest is dropped first.
CONTRACTS_REMEMBERED: Final = 4096

_Number = TypeVar("_Number", int, float)
# These types have the bounds that hold in settings and in the messages of peers.
Depth = Annotated[int, Meta(ge=1, le=limits.CONTRACT_DEPTH_MAX)]
Seconds = Annotated[float, Meta(ge=limits.CONTRACT_TIME_MIN, le=limits.CONTRACT_TIME_MAX)]
Rate = Annotated[float, Meta(ge=limits.CONTRACT_RATE_MIN, le=limits.CONTRACT_RATE_MAX)]
Outage = Annotated[float, Meta(ge=limits.OUTAGE_MIN, le=limits.OUTAGE_MAX)]


class Reliability(StrEnum):
    """Whether messages survive the loss of a link."""

    BEST_EFFORT = "best_effort"
    RELIABLE = "reliable"


class Durability(StrEnum):
    """Whether a late subscriber gets the last message of each source."""

    VOLATILE = "volatile"
    TRANSIENT_LOCAL = "transient_local"


class History(StrEnum):
    """Which messages a queue keeps when it is full: the last ``depth``, or all that fit its bytes."""

    KEEP_LAST = "keep_last"
    KEEP_ALL = "keep_all"


class Liveliness(StrEnum):
    """What shows that a publisher is alive: its link, or its own messages."""

    AUTOMATIC = "automatic"
    MANUAL_BY_TOPIC = "manual_by_topic"


class Priority(StrEnum):
    """The lane: express, bulk, or (normal) by the size of the messages."""

    HIGH = "high"
    NORMAL = "normal"
    LOW = "low"


class Transport(StrEnum):
    """The path of the messages: through both agents, or from node to node where possible (docs/guides/contracts.md).

    Attributes:
        DIRECT: From node to node; a warning where a condition fails and the agents relay instead.
        AUTO: As ``DIRECT``, without a warning.
    """

    RELAY = "relay"
    DIRECT = "direct"
    AUTO = "auto"


# The types of velocity commands, which replace each other: without a rule, ``depth`` is 1.
VELOCITY_COMMANDS: Final = frozenset(
    {
        "geometry_msgs/Twist",
        "geometry_msgs/TwistStamped",
        "ackermann_msgs/AckermannDrive",
        "ackermann_msgs/AckermannDriveStamped",
    }
)
# ``[bridge] transport`` and ``[services] transport`` where nothing sets them.
DEFAULT_TRANSPORT: Final = Transport.RELAY


@dataclass(frozen=True, slots=True)
class Contract:
    """The QoS of one topic; the defaults hold for a topic without any rule.

    Args:
        reliability: Whether messages survive the loss of a link.
        durability: Whether a late subscriber gets the last message.
        history: What a full queue keeps.
        depth: Messages that wait for one slow receiver, at least 1; not set: see ``queue_depth``. A term that is not
            set is left out in messages between agents.
        deadline: The longest time from one message to the next, in seconds; ``None``: no bound.
        lifespan: Seconds after which a message is dropped; ``None``: never.
        liveliness: What shows that a source is alive.
        liveliness_lease: Seconds without a sign of life after which a source counts as dead; ``None``: never.
        priority: The lane.
        max_rate: The most messages a second; above it the newest ones are sent. ``None``: no bound.
        outage: Seconds for which a reliable route keeps its messages when its link is lost; not set: see
            ``resume_window``.
        transport: The path of the messages. The default is what agents mean that do not send this field, whatever
            ``DEFAULT_TRANSPORT`` is.
    """

    reliability: Reliability = Reliability.BEST_EFFORT
    durability: Durability = Durability.VOLATILE
    history: History = History.KEEP_LAST
    depth: Depth | UnsetType = UNSET
    deadline: Seconds | None = None
    lifespan: Seconds | None = None
    liveliness: Liveliness = Liveliness.AUTOMATIC
    liveliness_lease: Seconds | None = None
    priority: Priority = Priority.NORMAL
    max_rate: Rate | None = None
    outage: Outage | UnsetType = UNSET
    transport: Transport = Transport.RELAY

    @property
    def newest_only(self) -> bool:
        """Whether only the newest one counts of the messages that an outage has delayed."""
        return self.depth == 1 and self.reliability is Reliability.BEST_EFFORT

    @property
    def queue_depth(self) -> int:
        """``depth``, or its default."""
        return limits.ROUTE_QUEUE_MESSAGES if self.depth is UNSET else self.depth

    @property
    def resume_window(self) -> float:
        """``outage``, or its default."""
        return limits.RESUME_WINDOW if self.outage is UNSET else self.outage

    @property
    def kept(self) -> int:
        """Messages kept for late subscribers with ``transient_local``: one, as latching does, or ``depth`` if set."""
        return 1 if self.depth is UNSET else self.depth

    def same_route(self, other: Contract) -> bool:
        """Whether a relayed route of this contract can go on with the other: they differ at most in the transport."""
        return replace(self, transport=other.transport) == other


# The names of a contract's fields, in order.
KEYS: Final = tuple(item.name for item in fields(Contract))
DEFAULT_CONTRACT: Final = Contract()
# Fields that only agents can keep where they differ from the default; the others are ``needs_agents``' own.
_AGENTS_WORDS: Final = ("reliability", "durability", "history", "depth")
# Which word of a field is the stronger one. Of the transports ``relay`` is the strongest, because it keeps the
# messages with the agents; ``direct`` wants its warning.
_RANKS: Final = {
    "reliability": tuple(Reliability).index,
    "durability": tuple(Durability).index,
    "history": tuple(History).index,
    "priority": (Priority.NORMAL, Priority.LOW, Priority.HIGH).index,
    "transport": (Transport.AUTO, Transport.DIRECT, Transport.RELAY).index,
}


def combine(offered: Contract, requested: Contract, type_name: str = "") -> Contract:
    """The contract of a route: the stronger of the sender's and the receiver's values, key by key.

    Args:
        offered: The sender's contract for the topic.
        requested: The receiver's. Its deadline and its liveliness (kind and lease together) hold where it has them:
            it is the receiver that waits.
        type_name: The type of a topic that is relayed. Velocity commands have a depth of 1 where neither side sets
            one, unless they are kept: reliable, ``keep_all`` or ``transient_local``.
    """
    watched = requested if requested.liveliness_lease is not None else offered
    stronger = {key: max(getattr(offered, key), getattr(requested, key), key=rank) for key, rank in _RANKS.items()}
    depth = _larger(offered.depth, requested.depth)
    kept = (Reliability.RELIABLE, History.KEEP_ALL, Durability.TRANSIENT_LOCAL)
    if depth is UNSET and type_name in VELOCITY_COMMANDS and not any(word in kept for word in stronger.values()):
        depth = 1
    return replace(
        DEFAULT_CONTRACT,
        **stronger,
        depth=depth,
        deadline=offered.deadline if requested.deadline is None else requested.deadline,
        lifespan=_smaller(offered.lifespan, requested.lifespan),
        liveliness=watched.liveliness,
        liveliness_lease=watched.liveliness_lease,
        max_rate=_smaller(offered.max_rate, requested.max_rate),
        outage=_larger(offered.outage, requested.outage),
    )


def needs_agents(contract: Contract) -> str:
    """The terms of a contract that only agents can keep, as text for users; empty if there are none.

    A route with such a term is relayed whatever its transport says. ``outage`` alone is no such term: it only says
    something about reliable routes.

    Returns:
        The terms in the order of the fields, such as ``reliability reliable, max_rate 10 Hz``.
    """
    seconds = (
        ("deadline", contract.deadline),
        ("lifespan", contract.lifespan),
        ("liveliness lease", contract.liveliness_lease),
    )
    terms = [
        f"{key} {value}"
        for key in _AGENTS_WORDS
        if (value := getattr(contract, key)) != getattr(DEFAULT_CONTRACT, key)
    ]
    terms += [f"{name} {value:g} s" for name, value in seconds if value is not None]
    if contract.priority is not Priority.NORMAL:
        terms.append(f"priority {contract.priority}")
    if contract.max_rate is not None:
        terms.append(f"max_rate {contract.max_rate:g} Hz")
    return ", ".join(terms)


def _larger(one: _Number | UnsetType, other: _Number | UnsetType) -> _Number | UnsetType:
    """The larger one of those that are set."""
    if one is UNSET or other is UNSET:
        return other if one is UNSET else one
    return max(one, other)


def _smaller(one: float | None, other: float | None) -> float | None:
    given = [value for value in (one, other) if value is not None]
    return min(given) if given else None


@dataclass(frozen=True, slots=True)
class ContractRule:
    """One ``[[contract]]``: the topics that it fits, and the values that it sets.

    Args:
        topics: Globs over topics (``core.identity.matches``), one of which must fit; empty: any topic.
        types: Globs over message types, likewise. A rule with both needs both to fit.
        values: The keys that it sets, named and typed as the fields of ``Contract``.
    """

    topics: tuple[str, ...]
    types: tuple[str, ...]
    values: Mapping[str, object] = field(hash=False)

    def fitting(self, topic: str, type_name: str) -> str | None:
        """The globs that fit, as text (``topics /cmd/**``); ``None`` where the rule does not apply."""
        shown = []
        for key, globs, name in (("topics", self.topics, topic), ("types", self.types, type_name)):
            if globs:
                glob = next((glob for glob in globs if matches(glob, name)), None)
                if glob is None:
                    return None
                shown.append(f"{key} {glob}")
        return ", ".join(shown) or "every topic"


class Contracts:
    """Finds a topic's contract: every rule that fits applies, in order; a later one overrides key by key.

    Args:
        rules: In the order of the file.
        default_transport: The transport of topics for which no rule sets one (``[bridge] transport``).
    """

    def __init__(
        self, rules: tuple[ContractRule, ...] = (), default_transport: Transport = DEFAULT_TRANSPORT
    ) -> None:
        self._rules = rules
        self._default = replace(DEFAULT_CONTRACT, transport=default_transport)
        self._find = lru_cache(CONTRACTS_REMEMBERED)(self._combined)

    def of(self, topic: str, type_name: str) -> Contract:
        """The contract of a topic. ``type_name`` may be empty or ``*`` while it is not known."""
        return self._find(topic, type_name) if self._rules else self._default

    def _combined(self, topic: str, type_name: str) -> Contract:
        values: dict[str, object] = {}
        for rule in self._rules:
            if rule.fitting(topic, type_name) is not None:
                values |= rule.values
        return replace(self._default, **values)  # type: ignore[arg-type] # as ContractRule.values promises

    def is_set(self, key: str, topic: str, type_name: str) -> bool:
        """Whether a rule sets a key of this topic's contract."""
        return any(key in rule.values for rule in self._rules if rule.fitting(topic, type_name) is not None)

    def explain(self, topic: str, type_name: str) -> dict[str, tuple[object, str]]:
        """Each key's value and where it comes from.

        Returns:
            By key: the value, and ``rule 2: topics /cmd/**`` (counted from 1), ``[bridge] transport`` or ``default``.
        """
        found: dict[str, tuple[object, str]] = {key: (getattr(self._default, key), "default") for key in KEYS}
        found |= {
            "depth": (DEFAULT_CONTRACT.queue_depth, "default"),
            "outage": (DEFAULT_CONTRACT.resume_window, "default"),
        }
        if type_name in VELOCITY_COMMANDS:
            found["depth"] = (1, "default for velocity commands")
        if self._default.transport is not DEFAULT_TRANSPORT:
            found["transport"] = (self._default.transport, "[bridge] transport")
        for number, rule in enumerate(self._rules, 1):
            fitting = rule.fitting(topic, type_name)
            if fitting is not None:
                found |= {key: (value, f"rule {number}: {fitting}") for key, value in rule.values.items()}
        return found
