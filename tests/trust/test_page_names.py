"""The names and addresses by which a module's page is opened: which of them its certificate may have."""

from __future__ import annotations

import pytest

from rmpa.trust import limits
from rmpa.trust.permissions import host_names, page_hosts, server_names


@pytest.mark.parametrize(
    ("wanted", "given"),
    [
        ("Robot1", "robot1"),
        ("robot1.local", "robot1.local"),
        ("arm.hall.lan.", "arm.hall.lan"),
        ("nas.home.arpa", "nas.home.arpa"),
        ("10.0.0.7", "10.0.0.7"),
        ("192.168.1.7", "192.168.1.7"),
        ("169.254.3.4", "169.254.3.4"),
        ("100.64.0.3", "100.64.0.3"),
        ("fd00::1", "fd00::1"),
        ("example.com", ""),  # the CA is to vouch for no host of the Internet
        ("robots.example.com", ""),
        ("local", "local"),
        ("8.8.8.8", ""),
        ("2001:4860:4860::8888", ""),
        ("127.0.0.2", ""),  # each machine's own
        ("localhost", ""),
        ("0.0.0.0", ""),
        ("224.0.0.1", ""),
        ("*.local", ""),
        ("a b", ""),
        ("-a.local", ""),
        ("", ""),
    ],
)
def test_hosts_of_the_local_network_alone(wanted: str, given: str) -> None:
    assert page_hosts([wanted]) == ((given,) if given else ())


def test_hosts_are_bounded_and_without_repetition() -> None:
    many = [f"10.0.0.{number}" for number in range(100)]
    assert page_hosts(["a", "A", *many]) == ("a", *many)[: limits.PAGE_HOSTS_MAX]


def test_the_names_of_a_machine_and_of_a_module() -> None:
    assert host_names("Robot-1.lab.example") == ("robot-1.lab.example", "robot-1", "robot-1.local")
    assert server_names("robot_1") == ("robot-1", "robot-1.local", "localhost")
