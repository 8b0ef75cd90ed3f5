"""The mesh that the monitor's page is measured with: as large as it says, moving, and changing with churn."""

from __future__ import annotations

import msgspec

from lab.web.mesh import Mesh
from rmpa.observe.snapshot import Snapshot
from rmpa.web.monitor.view import StateBuilder
from tests.web.snapshots import AGENT


def at(mesh: Mesh, seconds: float) -> Snapshot:
    return mesh.add(Snapshot(agent=AGENT, taken=mesh.began + seconds))


def test_sixteen_modules_have_three_hundred_topics_whose_figures_move() -> None:
    mesh, builder = Mesh("pc"), StateBuilder("pc")
    first = builder.build(at(mesh, 1.0))
    assert (len(first["modules"]), len(first["topics"])) == (16, 300)  # type: ignore[arg-type]
    rates = [at(mesh, second).topics[0].routes[0].rate for second in (1.0, 2.0, 3.0)]
    assert len({*rates}) == 3
    assert builder.build(at(mesh, 3.0))["topics"] != first["topics"]
    last = at(mesh, 9.0)
    assert msgspec.json.decode(msgspec.json.encode(last), type=Snapshot) == last


def test_with_churn_modules_and_topics_are_replaced() -> None:
    mesh = Mesh("pc", churn=2.0)
    before, after, later = (at(mesh, seconds) for seconds in (1.0, 3.0, 81.0))
    assert {peer.name for peer in before.peers} != {peer.name for peer in after.peers}
    renamed = {topic.name for topic in after.topics} - {topic.name for topic in before.topics}
    assert any(name.endswith("_1") for name in renamed)
    assert "visitor_0" in {peer.name for peer in after.peers}
    assert "visitor_1" in {peer.name for peer in later.peers}


def test_without_churn_only_figures_change() -> None:
    mesh = Mesh("pc")
    names = [[topic.name for topic in at(mesh, seconds).topics] for seconds in (1.0, 1000.0)]
    assert names[0] == names[1]
