"""The test bed without root: every host is this machine, with ports of its own; there are no cables.

What travels between hosts travels through loopback, so figures are of the programs and not of a network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lab.bed.namespaces import Host
from lab.bed.ros import free_port

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_NOTHING: Final = dict.fromkeys(("tx_bytes", "tx_packets", "rx_bytes", "rx_packets"), 0)


class Loopback:
    """Hosts that are this machine; see ``bed.system.Place``.

    Args:
        hosts: Their names.
    """

    can_cut: Final = False
    stock_master: Final = False

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = {name: Host(name) for name in hosts}
        self._ports = {name: free_port() for name in hosts}

    def host(self, name: str) -> Host:
        """This machine, by the host's name."""
        return self._hosts[name]

    def core_port(self, name: str) -> int:
        """Where the master or core of this host listens, restarts included."""
        return self._ports[name]

    def off(self, name: str) -> None:
        """Do nothing: there is no plug; whose processes they are ends them."""

    def on(self, name: str) -> None:
        """Do nothing."""

    def cut(self, name: str) -> None:
        """Do nothing: there is no cable."""

    def restore(self, name: str) -> None:
        """Do nothing."""

    def traffic(self, name: str) -> Mapping[str, int]:  # noqa: ARG002 - the same for all
        """Zeros: loopback's traffic is not counted by host."""
        return _NOTHING
