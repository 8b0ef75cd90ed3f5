"""The QoS of our topics in ROS 2 and in Zenoh, by contract."""

from __future__ import annotations

from rmpa.core.contract import ContractRule, Contracts, Durability, History, Priority, Reliability
from rmpa.gateway.ros2.format import ros2_qos, zenoh_qos
from rmpa.gateway.zenoh.threads import ZenohPriority


def terms(*, latching: bool = False, **values: object) -> tuple[str, bool, ZenohPriority, int, int]:
    """The QoS in the token; block, priority, bound and cache of Zenoh's publisher."""
    contracts = Contracts((ContractRule((), (), values),) if values else ())
    qos = ros2_qos(contracts, "/a", "std_msgs/String", latching=latching)
    zenoh = zenoh_qos(contracts.of("/a", "std_msgs/String"), qos)
    assert zenoh.reliable is zenoh.block
    return qos.serialize(), zenoh.block, zenoh.priority, zenoh.messages, zenoh.cache


def test_each_contract_has_its_qos() -> None:
    plain = terms()
    assert plain[:3] == ("::,10:,:,:,,", True, ZenohPriority.DATA), "reliable, as TCPROS is"
    assert plain[4] == 0
    assert terms(reliability=Reliability.RELIABLE) == plain
    assert terms(reliability=Reliability.BEST_EFFORT)[:2] == ("2::,10:,:,:,,", False)
    assert terms(latching=True)[0] == ":1:,1:,:,:,,"
    assert terms(latching=True)[4] == 1
    assert terms(durability=Durability.TRANSIENT_LOCAL, depth=7) == (":1:,7:,:,:,,", True, ZenohPriority.DATA, 7, 7)
    assert terms(history=History.KEEP_ALL)[0] == "::2,10:,:,:,,"
    assert terms(depth=5)[0] == "::,5:,:,:,,"
    assert terms(priority=Priority.HIGH)[2] is ZenohPriority.REAL_TIME
    assert terms(priority=Priority.LOW)[2] is ZenohPriority.DATA_LOW
    assert terms(deadline=0.5, lifespan=2.0, liveliness_lease=1.5)[0] == "::,10:0,500000000:2,0:,1,500000000"
