from __future__ import annotations

import pytest

from rmpa.core.identity import Guid, Identity, proxied_node, proxy_name, proxy_prefix

BASE = Identity(Guid.of("10.0.0.1", 40001), bytes(16), "base")


def test_a_proxy_tells_whom_it_stands_for() -> None:
    prefix = proxy_prefix(BASE, ())
    assert prefix == "/rmpa/base"
    assert proxy_name(prefix, "/ns/driver") == "/rmpa/base/ns/driver"
    assert proxied_node("/rmpa/base/ns/driver") == ("base", "/ns/driver")


def test_two_peers_of_one_name_have_proxies_apart() -> None:
    prefix = proxy_prefix(BASE, {"/rmpa/base"})
    assert prefix == "/rmpa/base_10_0_0_1_40001"
    assert proxied_node(proxy_name(prefix, "/driver")) == ("base_10_0_0_1_40001", "/driver")


@pytest.mark.parametrize("name", ["/driver", "/rmpa", "/rmpa/base", "/rmpanel/base/driver"])
def test_a_node_of_this_module_stands_for_itself(name: str) -> None:
    assert proxied_node(name) is None
