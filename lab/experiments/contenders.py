"""The systems that are compared, and their order in a round: classic ROS at its best, as it comes, and RMPA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from lab.bed.plan import Kind, Transport
    from lab.experiments.model import Cell, Measured, Results, Value


# The transport of RMPA's topics; ``mixed``: some of them are direct.
Way = Literal["relay", "direct", "mixed"]


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to run the same nodes.

    Args:
        label: Its name in tables and legends.
        system: Which system.
        nodelay: Whether subscribers ask for tcp_nodelay.
        relays: How many relays in C++ a message passes on its way.
        way: The transport of RMPA's topics.
    """

    label: str
    system: Kind
    nodelay: bool = True
    relays: int = 0
    way: Way = "relay"

    @property
    def settings(self) -> dict[str, Value]:
        """Those that tell it from the others in a cell.

        ``nodelay`` is one of classic ROS: an agent sends at once whatever its subscribers ask for. Runs from before
        there was a direct transport have no ``transport``: what they measured was relayed.
        """
        if self.system == "rmpa":
            return self.kind_settings
        relayed: dict[str, Value] = {"relays": self.relays} if self.relays else {}
        return {"system": self.system, "nodelay": self.nodelay, **relayed}

    @property
    def kind_settings(self) -> dict[str, Value]:
        """Those that tell the system and its transport."""
        return {"system": self.system} if self.way == "relay" else {"system": self.system, "transport": self.way}

    @property
    def look(self) -> str:
        """What decides its colour in figures (``figures.colours``)."""
        return self.system if self.way == "relay" else self.way

    def select(self, results: Results, **settings: Value) -> Iterator[tuple[Cell, Measured]]:
        """The cells of this one, and of no other, that have these settings."""
        for cell, measured in results.select(**self.settings, **settings):
            if relays_of(cell) == self.relays and way_of(cell) == self.way:
                yield cell, measured


# With tcp_nodelay: its best setting, and what RMPA is held against.
CLASSIC: Final = Contender("classic", "classic")
# As it comes.
DEFAULTS: Final = Contender("classic, nodelay off", "classic", nodelay=False)
# With as many processes between as RMPA has: a relay in C++ on either host, also with tcp_nodelay.
RELAYS: Final = Contender("classic, two relays", "classic", relays=2)
# Relayed: each message passes both agents.
RMPA: Final = Contender("RMPA", "rmpa")
# From node to node; the agents have only made it so.
DIRECT: Final = Contender("RMPA direct", "rmpa", way="direct")
# Images from node to node, commands through the agents.
MIXED: Final = Contender("RMPA, images direct", "rmpa", way="mixed")
# Those that take turns in every experiment.
COMPARED: Final = (CLASSIC, RMPA, DIRECT)


def turn(order: Sequence[Contender], number: int) -> list[Contender]:
    """The order of one round; each round starts with another system, so that none always follows the same one."""
    first = number % len(order)
    return [*order[first:], *order[:first]]


def system_of(cell: Cell) -> Kind:
    """The kind of system that a cell asks for."""
    return "rmpa" if cell.settings["system"] == "rmpa" else "classic"


def way_of(cell: Cell) -> Way:
    """The transport that a cell asks for."""
    found = cell.settings.get("transport")
    return "direct" if found == "direct" else "mixed" if found == "mixed" else "relay"


def transport_of(cell: Cell) -> Transport:
    """The transport of the topics for which the experiment has no contract."""
    return "direct" if way_of(cell) == "direct" else "relay"


def contender_of(cell: Cell) -> Contender:
    """The one that a cell is of, in experiments that have classic ROS at its best only."""
    return {one.way: one for one in (RMPA, DIRECT, MIXED)}[way_of(cell)] if system_of(cell) == "rmpa" else CLASSIC


def relays_of(cell: Cell) -> int:
    """How many relays its messages pass."""
    relays = cell.settings.get("relays", 0)
    return relays if isinstance(relays, int) else 0


def nodelay_of(cell: Cell) -> bool:
    """Whether its subscribers ask for tcp_nodelay: the same nodes as classic's best, with RMPA."""
    return cell.settings.get("nodelay", True) is True
