"""Signs in the rules of real firewalls."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.observe.doctor.network import judge_rules, names_port, read_iptables, read_nft
from rmpa.observe.peer_info import CheckLevel

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


@pytest.mark.parametrize(
    ("text", "level", "part"),
    [
        ("", CheckLevel.OK, "0 rules"),
        (NFT_OPEN, CheckLevel.OK, "1 rules, and none against agents"),
        (NFT_CLOSED, CheckLevel.WARN, "inet filter input drops what no rule lets in"),
        (NFT_OURS, CheckLevel.OK, "lets ours in: udp dport { 5353, 11400-11450 } accept"),
        (NFT_AGAINST, CheckLevel.FAIL, "drops what agents send: udp dport 11411 counter"),
        (NFT_UDP, CheckLevel.FAIL, "drops all UDP, also beacons of agents: meta l4proto udp drop"),
        (NFT_UDP.replace("l4proto udp", "l4proto { tcp, udp }"), CheckLevel.FAIL, "drops all UDP"),
        (NFT_UDP.replace('iif "lo"', "udp dport 11411"), CheckLevel.OK, "none against agents"),
        (NFT_UDP.replace('iif "lo"', "tcp dport 40001"), CheckLevel.FAIL, "drops all UDP"),
        (NFT_UDP.replace("l4proto udp", "l4proto tcp"), CheckLevel.OK, "none against agents"),
        (NFT_UDP.replace("meta", 'iifname "docker0" meta'), CheckLevel.OK, "none against agents"),
    ],
)
def test_nft(text: str, level: CheckLevel, part: str) -> None:
    found = judge_rules(read_nft(text, PORTS), "UDP port 11411")
    assert (found.level, found.where) == (level, "nft")
    assert part in found.text
    assert bool(found.remedy) is (level is not CheckLevel.OK)


@pytest.mark.parametrize(
    ("text", "level"),
    [
        ("-P INPUT ACCEPT\n-P FORWARD ACCEPT\n-P OUTPUT ACCEPT\n", CheckLevel.OK),
        (IPTABLES_UFW, CheckLevel.WARN),
        (IPTABLES_UFW + "-A ufw-user-input -p udp -m udp --dport 11411 -j ACCEPT\n", CheckLevel.OK),
        (IPTABLES_UFW + "-A ufw-user-input -p tcp -m multiport --dports 40000:40010 -j ACCEPT\n", CheckLevel.OK),
        ("-P INPUT ACCEPT\n-A INPUT -p tcp -m tcp --dport 40001 -j REJECT\n", CheckLevel.FAIL),
        ("-P INPUT ACCEPT\n-A INPUT -p tcp -m tcp --dport 22 -j REJECT\n", CheckLevel.OK),
        ("-P INPUT ACCEPT\n-A INPUT -p udp -j DROP\n", CheckLevel.FAIL),
        ("-P INPUT ACCEPT\n-A INPUT -p udp -j REJECT --reject-with icmp-port-unreachable\n", CheckLevel.FAIL),
        ('-P INPUT ACCEPT\n-A INPUT -p udp -m comment --comment "no UDP" -j DROP\n', CheckLevel.FAIL),
        ("-P INPUT ACCEPT\n-A INPUT -s 10.0.0.0/8 -p udp -j DROP\n", CheckLevel.OK),
        ("-P INPUT ACCEPT\n-A INPUT -p udp -m udp --dport 53 -j DROP\n", CheckLevel.OK),
    ],
)
def test_iptables(text: str, level: CheckLevel) -> None:
    assert judge_rules(read_iptables(text, PORTS), "UDP port 11411").level is level


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
