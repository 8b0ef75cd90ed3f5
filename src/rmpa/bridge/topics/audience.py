"""Topics whose publisher looks at the names of its listeners, not only at whether there are any.

An actionlib client believes in a server once the node that publishes the status listens to the client's goals and
cancellations, too (``wait_for_server``, ``waitForServer``): it compares the caller ids of the connections. Over the
mesh one connection of the agent stands for all listeners of a module; so for these topics the listeners' names cross,
and the publisher's agent connects once more for each, under the name that the listener has there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.messages import is_crossing_name
from rmpa.bridge.policy import OWN_NODE

if TYPE_CHECKING:
    from collections.abc import Iterable

_GOAL: Final = "ActionGoal"
_CANCEL: Final = "actionlib_msgs/GoalID"


def is_watched(type_name: str) -> bool:
    """Whether publishers of this type look at their listeners' names; by the type, for a topic can be remapped."""
    return type_name.endswith(_GOAL) or type_name == _CANCEL


def audience(caller_ids: Iterable[str]) -> tuple[str, ...]:
    """The nodes to name to a publisher: sorted, each once, at most ``limits.AUDIENCE_MAX``, but for the agent.

    Proxies listen to proxies only where this module relays: there a listener of another module is named by it.
    """
    names = {name for name in caller_ids if is_crossing_name(name) and name != OWN_NODE}
    return tuple(sorted(names)[: limits.AUDIENCE_MAX])
