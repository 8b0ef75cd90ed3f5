"""Assigns loopback addresses ``127.a.b.c`` to nodes that share one port: the dialled address identifies the node."""

from __future__ import annotations

import hashlib
import itertools
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

_FIRST: Final = 254
"""Values of ``a``, from 1 on: 127.0/16 has localhost, Debian's 127.0.1.1 and the resolvers; 127.255/16 broadcasts."""
_SECOND: Final = 256
_THIRD: Final = 254
"""Values of ``c``, from 1 on: an address that ends in 0 or 255 looks like a network's own."""


class LoopbackAddresses:
    """The loopback addresses in use, and those freed a short while ago.

    An address is a hash of the node's name: it is the same after a restart, and hardly ever another node's, so a
    client with an old address is refused instead of reaching the wrong node. A freed address is not used again for
    ``limits.LOOPBACK_REST``, even for the same node: rospy takes a URI that it has just lost for one that it still
    has, and does not reconnect.

    Args:
        salt: Distinguishes nodes of one name in several graphs of this machine, such as the master's URI.
    """

    def __init__(self, salt: str) -> None:
        self._salt = salt
        self._used: set[str] = set()
        self._resting: OrderedDict[str, float] = OrderedDict()

    def __len__(self) -> int:
        """Addresses in use."""
        return len(self._used)

    def take(self, name: str, now: float) -> str:
        """Assign an address to a node.

        Args:
            name: The node's name.
            now: Monotonic seconds.
        """
        self._release_rested(now)
        # There are 16 million addresses, and far fewer nodes and resting ones (LOOPBACK_RESTING_MAX).
        address = next(a for a in self._candidates(name) if a not in self._used and a not in self._resting)
        self._used.add(address)
        return address

    def free(self, address: str, now: float) -> None:
        """Free an address; nothing happens if it is not in use.

        Args:
            address: As ``take`` gave it.
            now: Monotonic seconds.
        """
        if address in self._used:
            self._used.remove(address)
            self._resting[address] = now
            self._release_rested(now)

    def _release_rested(self, now: float) -> None:
        """Release addresses that rested long enough, and the oldest of too many."""
        while self._resting:
            since = next(iter(self._resting.values()))
            if now - since < limits.LOOPBACK_REST and len(self._resting) <= limits.LOOPBACK_RESTING_MAX:
                return
            self._resting.popitem(last=False)

    def _candidates(self, name: str) -> Iterator[str]:
        for attempt in itertools.count():
            text = f"{self._salt}\0{name}\0{attempt}"
            number = int.from_bytes(hashlib.blake2s(text.encode(errors="backslashreplace"), digest_size=8).digest())
            rest, third = divmod(number, _THIRD)
            first, second = divmod(rest % (_FIRST * _SECOND), _SECOND)
            yield f"127.{1 + first}.{second}.{1 + third}"
