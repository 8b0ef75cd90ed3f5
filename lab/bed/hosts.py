"""The test bed with real hosts: network namespaces on one switch, as the paper's four boards were on theirs (Fig. 7).

What a host sends is limited to what its cable carries; what it gets is not, which makes no difference while one
sender alone fills its cable.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lab.bed.namespaces import Host, Lab

_CORE_PORT: Final = 11311


class NetworkPlace:
    """Hosts of one lab; see ``bed.system.Place``.

    Args:
        lab: Where they are made.
        hosts: Their names.
        link: What each cable carries (``100mbit``); empty for unshaped.
        bands: Whether packets leave a shaped cable by the kernel's usual three bands.
    """

    can_cut: Final = True
    stock_master: Final = True

    def __init__(self, lab: Lab, hosts: Sequence[str], *, link: str, bands: bool) -> None:
        self._lab = lab
        self._link, self._bands = link, bands
        self._hosts = {name: lab.host(name, 0) for name in hosts}
        for host in self._hosts.values():
            self._shape(host)

    def host(self, name: str) -> Host:
        """The host of this name."""
        return self._hosts[name]

    def core_port(self, name: str) -> int:  # noqa: ARG002 - each has all ports to itself
        """ROS's own."""
        return _CORE_PORT

    def off(self, name: str) -> None:
        """Pull its plug; all processes there have ended when this returns."""
        self._lab.power_off(self._hosts[name])

    def on(self, name: str) -> None:
        """Switch it on again."""
        self._lab.power_on(self._hosts[name])
        self._shape(self._hosts[name])

    def cut(self, name: str) -> None:
        """Pull its cable out."""
        self._hosts[name].cut()

    def restore(self, name: str) -> None:
        """Put its cable in again."""
        self._hosts[name].restore()

    def traffic(self, name: str) -> Mapping[str, int]:
        """What went through its cable since it was plugged."""
        return self._hosts[name].traffic()

    def _shape(self, host: Host) -> None:
        if self._link:
            host.shape(self._link, bands=self._bands)
