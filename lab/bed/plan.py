"""What a run is asked for: where, with whose nodes, on which cables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# Which system: one roscore for all hosts, or one agent and core on each host.
Kind = Literal["classic", "rmpa"]
# How RMPA brings messages from module to module: through both agents, or straight from node to node.
Transport = Literal["relay", "direct"]
Size = Literal["short", "full"]
# Whose nodes: the ROS client library.
Client = Literal["rospy", "roscpp"]


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run was asked for.

    Args:
        size: ``full`` for figures to quote; ``short`` to see in a minute or two that everything works.
        clients: Whose nodes take part.
        link: What each host's cable carries, as ``tc`` writes it (``100mbit``); empty for unshaped.
        seed: Of all that is left to chance (the order of cells, phases).
    """

    size: Size = "full"
    clients: tuple[Client, ...] = ("rospy", "roscpp")
    link: str = "100mbit"
    seed: int = 1

    @property
    def short(self) -> bool:
        """Whether this is only to see that everything works."""
        return self.size == "short"
