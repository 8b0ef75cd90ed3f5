"""Signs in the rules of real firewalls."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.observe.check import CheckLevel
from rmpa.observe.doctor.network import FirewallRules, judge_rules, names_port, read_iptables, read_nft

if TYPE_CHECKING:
    from collections.abc import Callable

PORTS = frozenset({11411, 40001})
NFT_OPEN = """\
table ip nat {
	chain POSTROUTING {
		type nat hook postrouting priority srcnat; policy accept;
		ip saddr 172.17.0.0/16 masquerade
	}
}
"""
NFT_CLOSED = """\
table inet filter {
	chain input {
		type filter hook input priority filter; policy drop;
		ct state established,related accept
		iif "lo" accept
		tcp dport 22 accept
	}
	chain output {
		type filter hook output priority filter; policy accept;
	}
}
"""
NFT_OURS = NFT_CLOSED.replace("tcp dport 22 accept", "udp dport { 5353, 11400-11450 } accept")
NFT_AGAINST = NFT_CLOSED.replace("policy drop", "policy accept").replace(
    "tcp dport 22 accept", "udp dport 11411 counter packets 3 bytes 90 drop"
)
NFT_UDP = """\
table inet cut {
	chain in {
		type filter hook input priority filter; policy accept;
		iif "lo" accept
		meta l4proto udp drop
	}
	chain out {
		type filter hook output priority filter; policy accept;
		meta l4proto udp counter packets 3 bytes 90 drop
	}
}
"""
IPTABLES_UFW = """\
-P INPUT DROP
-P FORWARD DROP
-P OUTPUT ACCEPT
-N ufw-user-input
-A INPUT -j ufw-user-input
-A ufw-user-input -p tcp -m tcp --dport 22 -j ACCEPT
"""


def nft(text: str) -> Callable[[], FirewallRules]:
    return partial(read_nft, text, PORTS)


def iptables(*rules: str) -> Callable[[], FirewallRules]:
    return partial(read_iptables, "\n".join(rules), PORTS)


OPEN = "-P INPUT ACCEPT"
RULES: dict[str, Callable[[], FirewallRules]] = {
    "ok, none": nft(""),
    "ok, of containers": nft(NFT_OPEN),
    "warn, closed": nft(NFT_CLOSED),
    "ok, ours": nft(NFT_OURS),
    "fail, against ours": nft(NFT_AGAINST),
    "fail, all UDP": nft(NFT_UDP),
    "fail, all UDP among others": nft(NFT_UDP.replace("l4proto udp", "l4proto { tcp, udp }")),
    "ok, all UDP but ours": nft(NFT_UDP.replace('iif "lo"', "udp dport 11411")),
    "fail, all UDP, though TCP comes in": nft(NFT_UDP.replace('iif "lo"', "tcp dport 40001")),
    "ok, all TCP": nft(NFT_UDP.replace("l4proto udp", "l4proto tcp")),
    "ok, UDP of one interface": nft(NFT_UDP.replace("meta", 'iifname "docker0" meta')),
    "ok, iptables": iptables(OPEN, "-P FORWARD ACCEPT", "-P OUTPUT ACCEPT"),
    "warn, ufw": iptables(IPTABLES_UFW),
    "ok, ufw with UDP": iptables(IPTABLES_UFW, "-A ufw-user-input -p udp -m udp --dport 11411 -j ACCEPT"),
    "ok, ufw with TCP": iptables(
        IPTABLES_UFW, "-A ufw-user-input -p tcp -m multiport --dports 40000:40010 -j ACCEPT"
    ),
    "fail, a reject": iptables(OPEN, "-A INPUT -p tcp -m tcp --dport 40001 -j REJECT"),
    "ok, another port": iptables(OPEN, "-A INPUT -p tcp -m tcp --dport 22 -j REJECT"),
    "fail, no UDP": iptables(OPEN, "-A INPUT -p udp -j DROP"),
    "fail, UDP rejected": iptables(OPEN, "-A INPUT -p udp -j REJECT --reject-with icmp-port-unreachable"),
    "fail, a comment": iptables(OPEN, '-A INPUT -p udp -m comment --comment "no UDP" -j DROP'),
    "ok, UDP of one network": iptables(OPEN, "-A INPUT -s 10.0.0.0/8 -p udp -j DROP"),
    "ok, UDP of one port": iptables(OPEN, "-A INPUT -p udp -m udp --dport 53 -j DROP"),
}


@pytest.mark.parametrize(("name", "rules"), RULES.items(), ids=RULES)
def test_signs(name: str, rules: Callable[[], FirewallRules]) -> None:
    found = judge_rules(rules(), "UDP port 11411")
    assert found.level == name.partition(",")[0]
    assert bool(found.remedy) is (found.level is not CheckLevel.OK)


def test_a_port_is_not_its_neighbour() -> None:
    assert names_port("tcp dport 40001 accept", PORTS)
    assert names_port("tcp dport 40000-40001 accept", PORTS)
    assert not names_port("tcp dport 40002-40010 accept", PORTS)
    assert not names_port("tcp dport 4000 accept", PORTS)
    assert not names_port("udp sport 11411 accept", PORTS)


@given(st.text(alphabet="table chin{}type filter hook input policy drop;-AP INPUT 0123456789\n:-", max_size=400))
def test_whatever_is_printed_is_read(text: str) -> None:
    judge_rules(read_nft(text, PORTS), "")
    judge_rules(read_iptables(text, PORTS), "")
