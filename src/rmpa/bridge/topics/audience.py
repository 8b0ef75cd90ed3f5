"""Topics whose publisher checks the names of its listeners, not only whether there are any.

An actionlib client accepts a server (``wait_for_server``, ``waitForServer``) when the node that publishes the status
also listens to the client's goals and cancellations. It compares the caller ids of the connections. Over the mesh,
one connection of the agent stands for all listeners of a module. For these topics, therefore, the listeners' names
cross, and the publisher's agent opens one more connection for each, under the listener's name in the publisher's
graph.
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
_STATUS: Final = "actionlib_msgs/GoalStatusArray"
_ANSWERS: Final = ("ActionResult", "ActionFeedback")


def is_watched(type_name: str) -> bool:
    """Whether publishers of this type check their listeners' names; judged by type, as topics can be remapped."""
    return type_name.endswith(_GOAL) or type_name == _CANCEL


def compares_names(type_name: str) -> bool:
    """Whether a topic is of an action, whose client compares the names in the headers of all five topics.

    rospy's client wants one name as listener of goals and cancellations, and as publisher of status, result and
    feedback; roscpp's leaves the last two out. So all have to come by the agents, which give a remote node one name.
    """
    return is_watched(type_name) or type_name == _STATUS or type_name.endswith(_ANSWERS)


def audience(caller_ids: Iterable[str]) -> tuple[str, ...]:
    """The listeners to name to a publisher: sorted, without the agent itself, at most ``limits.AUDIENCE_MAX``.

    Proxies are included: they listen to proxies only in a relay, and name listeners of the modules beyond it.
    """
    names = {name for name in caller_ids if is_crossing_name(name) and name != OWN_NODE}
    return tuple(sorted(names)[: limits.AUDIENCE_MAX])
