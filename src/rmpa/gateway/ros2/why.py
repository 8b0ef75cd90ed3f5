"""``rmpa why`` between modules and ROS 2: the stages of a topic's way, from what the neighbour reports. Without I/O.

::

    out: rule ─ type ─ heard (hashes) ─ demand ─ sent          in: rule ─ type ─ shown ─ demand ─ arrived
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.gateway.ros2.crossing import SITE
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.observe.why.diagnosis import Diagnosis, until_failure

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_RULES: Final = "change [[gateway.rule]] in the rmpa.toml of the gateway, and reload it"
_LOST: Final = {
    "lost": "were lost on the way, by their numbers",
    "dropped": "were dropped by a full queue",
    "limited": "were left out for the rule's rate or size",
    "unconverted": "could not be converted",
    "unheard": "came before a node subscribed",
}


def topic_ways(report: Mapping[str, Any], name: str, gateway: str, *, here_only: bool = False) -> list[Diagnosis]:
    """The ways of a topic from ROS 2 to the modules, and from the modules to ROS 2.

    Args:
        report: What the neighbour reports.
        name: The topic, by its name here; with ``here_only`` also by its name in ROS 2.
        gateway: The gateway's name.
        here_only: Whether only what comes from ROS 2 is meant.
    """
    problems: Mapping[str, str] = report["problems"]
    ways: list[Diagnosis] = []
    for row in report["topics"]:
        coming = row["direction"] == "in"
        if name != row["here"] and not (here_only and coming and name == row["topic"]):
            continue
        if coming:
            stages = until_failure(_in_stages(row))
            ways.append(Diagnosis.of(stages, name=row["here"], peer=SITE, to=gateway, node=row["node"]))
        elif not here_only:
            stages = until_failure(_out_stages(row, problems))
            ways.append(Diagnosis.of(stages, name=name, peer=row["module"], to=SITE, node=row["node"]))
    for what, why in report["topics_refused"].items():
        topic, _, node = what.partition(" of ")
        if topic == name:
            from_ros2 = not node.startswith("/rmpa/")
            if from_ros2 or not here_only:
                ends = {"peer": SITE, "to": gateway} if from_ros2 else {"peer": gateway, "to": SITE}
                ways.append(Diagnosis.of((Check("rule", FAIL, why, _RULES),), name=name, node=node, **ends))
    return ways


def _out_stages(row: Mapping[str, Any], problems: Mapping[str, str]) -> Iterator[Check]:
    yield Check("rule", OK, row["rule"])
    if row["problem"]:
        yield Check("type", FAIL, row["problem"])
    if not row["ros2_type"]:
        yield Check("type", WARN, f"ROS 2 has no {row['type']}; its publisher is being asked for the definition")
        return
    kept = ", transient local" if row["latched"] else ""
    yield Check("type", OK, f"it is {row['ros2_type']} in ROS 2{kept}")
    deaf = [f"{what.partition(' of ')[2]}: {text}" for what, text in problems.items() if _is_end(what, row["here"])]
    if deaf:
        yield Check("heard", FAIL if not row["wanted"] else WARN, "; ".join(deaf))
    if not row["wanted"]:
        yield Check("demand", WARN, "no node of ROS 2 subscribes: nothing is sent")
        return
    yield Check("demand", OK, "a node of ROS 2 subscribes")
    waiting = f", {row['waiting']} wait" if row["waiting"] else ""
    yield _flow("sent", f"{row['sent']} messages were sent{waiting}", row, row["sent"])


def _in_stages(row: Mapping[str, Any]) -> Iterator[Check]:
    yield Check("rule", OK, row["rule"])
    if row["problem"]:
        yield Check("type", FAIL, row["problem"])
    kept = ", transient local" if row["latched"] else ""
    yield Check("type", OK, f"{row['ros2_type']} of ROS 2 is {row['type']} here{kept}")
    was = f" (ROS 2's {row['topic']})" if row["topic"] != row["here"] else ""
    yield Check("shown", OK, f"it is {row['here']} here{was}, at /rmpa/{SITE}{row['node']}")
    if not row["wanted"]:
        yield Check("demand", WARN, "no node of a module subscribes: it crosses once one does")
        return
    yield Check("demand", OK, "a node of a module subscribes")
    yield _flow("arrived", f"{row['received']} messages have come", row, row["received"])


def _flow(stage: str, text: str, row: Mapping[str, Any], messages: int) -> Check:
    lost = [f"{row[key]} {words}" for key, words in _LOST.items() if row.get(key)]
    return Check(stage, OK if messages and not lost else WARN, "; ".join((text, *lost)))


def _is_end(what: str, name: str) -> bool:
    """Whether a problem is one of a ROS 2 node with a topic of this name."""
    topic, _, node = what.partition(" of ")
    return topic == name and node.startswith("/") and not node.startswith("/rmpa/")
