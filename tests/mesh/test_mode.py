"""Whether all links stay, or only those in use: by the settings, and by the number of modules with hysteresis."""

from __future__ import annotations

import pytest

from rmpa.core.links import Links
from rmpa.mesh.mode import MeshMode


def test_a_small_mesh_is_a_full_one_and_a_large_one_links_on_demand() -> None:
    mode = MeshMode(Links.AUTO, 64)
    assert [mode.count(64), mode.demand] == [False, False]
    assert [mode.count(65), mode.demand] == [True, True]
    assert str(mode) == "links on demand (65 modules, more than mesh.full_mesh_up_to = 64)"


def test_the_mode_does_not_flicker_when_modules_come_and_go_at_the_limit() -> None:
    mode = MeshMode(Links.AUTO, 64)
    mode.count(65)
    assert not any(mode.count(modules) for modules in (64, 65, 63, 66, 48))
    assert mode.demand
    assert "until there are fewer than 48" in mode.reason
    assert mode.count(47)
    assert str(mode) == "full mesh (47 modules, mesh.full_mesh_up_to = 64)"
    assert not mode.count(64)


@pytest.mark.parametrize(("links", "demand"), [(Links.FULL, False), (Links.DEMAND, True)])
def test_the_setting_decides_at_any_size(links: Links, demand: bool) -> None:
    mode = MeshMode(links, 64)
    for modules in (1, 2, 64, 1000, 2):
        assert not mode.count(modules)
        assert mode.demand is demand
    assert mode.reason == f'mesh.links = "{links}"'


def test_the_smallest_limit_has_a_way_back() -> None:
    mode = MeshMode(Links.AUTO, 1)
    assert mode.count(2)
    assert mode.count(1)
    assert not mode.demand
