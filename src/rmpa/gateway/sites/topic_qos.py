"""From a topic's contract to Zenoh's QoS (docs/design/gateway.md, "Contracts"): a pure table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.contract import Priority, Reliability
from rmpa.gateway import limits
from rmpa.gateway.zenoh_api import ZenohPriority, ZenohQos

if TYPE_CHECKING:
    from rmpa.core.contract import Contract


def qos_of(contract: Contract, *, latching: bool = False, large: bool = False) -> ZenohQos:
    """The QoS of one topic's publisher.

    A thread waits for Zenoh; what exceeds the queue before it is dropped there and counted. None has the congestion
    control ``BLOCK``: it ends the link behind which a message waits for seconds, as each large one does on a thin
    link. With ``DROP`` a message waits likewise (``zenoh.limits.DROP_WAIT``), and the link stays; the receiver counts
    what is lost there by its number.

    Args:
        contract: The topic's.
        latching: Whether a late subscriber gets the last message.
        large: Whether its messages are large: they yield to others unless the contract has a priority.
    """
    if contract.priority is Priority.HIGH:
        priority = ZenohPriority.REAL_TIME
    elif contract.priority is Priority.LOW or large:
        priority = ZenohPriority.DATA_LOW
    else:
        priority = ZenohPriority.DATA
    return ZenohQos(
        reliable=True,
        block=False,
        priority=priority,
        messages=contract.depth,
        bytes=limits.RELIABLE_BYTES if contract.reliability is Reliability.RELIABLE else limits.BEST_EFFORT_BYTES,
        cache=1 if latching else 0,
    )
