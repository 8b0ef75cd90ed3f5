"""The QoS of a topic that goes out to ROS 2: its contract in ROS 2's words, and in Zenoh's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.contract import Durability, History, Liveliness, Priority, Reliability
from rmpa.core.limits import ROUTE_QUEUE_MESSAGES
from rmpa.gateway.ros2.qos import (
    DEFAULT_DEPTH,
    INFINITE,
    Ros2Durability,
    Ros2History,
    Ros2Liveliness,
    Ros2Qos,
    Ros2Reliability,
)
from rmpa.gateway.zenoh_api import ZenohPriority, ZenohQos

if TYPE_CHECKING:
    from rmpa.core.contract import Contract, Contracts

_PRIORITIES: Final = {
    Priority.HIGH: ZenohPriority.REAL_TIME,
    Priority.NORMAL: ZenohPriority.DATA,
    Priority.LOW: ZenohPriority.DATA_LOW,
}


def ros2_qos(contracts: Contracts, topic: str, type_name: str, *, latching: bool) -> Ros2Qos:
    """The QoS of a topic's publisher in ROS 2's graph.

    A topic whose contract no rule makes *best effort* is reliable, as TCPROS is and as ROS 2's default has it.

    Args:
        contracts: The rules.
        topic: The topic.
        type_name: ``package/Name`` of ROS 1.
        latching: Whether its publisher latches: then it is transient local with a depth of 1.
    """
    contract = contracts.of(topic, type_name)
    best_effort = _best_effort(contracts, topic, type_name)
    kept = latching or contract.durability is Durability.TRANSIENT_LOCAL
    manual = contract.liveliness is Liveliness.MANUAL_BY_TOPIC
    return Ros2Qos(
        Ros2Reliability.BEST_EFFORT if best_effort else Ros2Reliability.RELIABLE,
        Ros2Durability.TRANSIENT_LOCAL if kept else Ros2Durability.VOLATILE,
        Ros2History.KEEP_ALL if contract.history is History.KEEP_ALL else Ros2History.KEEP_LAST,
        contract.kept if kept else DEFAULT_DEPTH if contract.depth == ROUTE_QUEUE_MESSAGES else contract.depth,
        _nanoseconds(contract.deadline),
        _nanoseconds(contract.lifespan),
        Ros2Liveliness.MANUAL_BY_TOPIC if manual else Ros2Liveliness.AUTOMATIC,
        _nanoseconds(contract.liveliness_lease),
    )


def zenoh_qos(contract: Contract, qos: Ros2Qos) -> ZenohQos:
    """The QoS of its Zenoh publisher, and the bounds of its queue.

    Args:
        contract: The contract.
        qos: What ``ros2_qos`` made of it. What is reliable waits for slow receivers (``BLOCK``), in its queue.
    """
    reliable = qos.reliability is Ros2Reliability.RELIABLE
    return ZenohQos(
        reliable=reliable,
        block=reliable,
        priority=_PRIORITIES[contract.priority],
        messages=contract.depth,
        cache=qos.depth if qos.latched else 0,
    )


def _best_effort(contracts: Contracts, topic: str, type_name: str) -> bool:
    value, origin = contracts.explain(topic, type_name)["reliability"]
    return value is Reliability.BEST_EFFORT and origin != "default"


def _nanoseconds(seconds: float | None) -> int:
    return INFINITE if seconds is None else round(seconds * 1e9)
