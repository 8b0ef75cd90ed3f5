"""What may cross the mesh: a pure table of rules that can say which of them decided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.names import matches

if TYPE_CHECKING:
    from rmpa.core.config import PolicySettings

OWN_NODE: Final = "/rmpa"
"""The agent's own node; what it stands for lives below: ``/rmpa/<peer>/<node>``."""

BUILT_IN_DENY: Final = {
    "/rosout": "log messages stay home: a bridged /rosout would loop",
    "/rosout_agg": "log messages stay home: a bridged /rosout would loop",
    "/clock": "time stays home: two clocks in one graph make it jump",
    "/rmpa/**": "the agent's own topics stay home",
}
"""Topics that never cross, and why."""


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether a source may cross, and the rule that says so, ready to show."""

    allowed: bool
    rule: str


def is_own(node: str) -> bool:
    """Whether a local node is the agent itself or stands for a node of another module."""
    return node == OWN_NODE or node.startswith(OWN_NODE + "/")


class Policy:
    """Judges sources by their topic, type and node.

    Args:
        settings: The user's globs.
    """

    def __init__(self, settings: PolicySettings) -> None:
        self._settings = settings

    def judge(self, topic: str, type_name: str, node: str) -> Decision:
        """Decide about one source; the first "no" wins, in the order of the table below."""
        if is_own(node):
            return Decision(False, f"{node} stands for a node of another module, or is the agent itself")
        for pattern, why in BUILT_IN_DENY.items():
            if matches(pattern, topic):
                return Decision(False, f"built in: {why}")
        for key, patterns, name in (
            ("bridge.deny", self._settings.deny, topic),
            ("bridge.deny_types", self._settings.deny_types, type_name),
        ):
            for pattern in patterns:
                if matches(pattern, name):
                    return Decision(False, f"{key} has {pattern!r}")
        if not any(matches(pattern, type_name) for pattern in self._settings.allow_types):
            return Decision(False, f"no glob of bridge.allow_types fits {type_name}")
        for pattern in self._settings.allow:
            if matches(pattern, topic):
                return Decision(True, f"bridge.allow has {pattern!r}")
        return Decision(False, f"no glob of bridge.allow fits {topic}")
