"""Room in the kernel's table of neighbours (ARP), which all network namespaces of a machine share.

Each of 64 hosts on one bridge talks to 63 others: 4,032 entries, of which Linux allows 1,024. What finds no room is
dropped, and the kernel's log says *neighbor table overflow*.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_FOLDER: Final = Path("/proc/sys/net/ipv4/neigh/default")


@contextmanager
def room_for(hosts: int, folder: Path = _FOLDER) -> Iterator[None]:
    """Raise the limits of the table as far as so many hosts that all talk to each other need, and put them back.

    Where that is not allowed, as in most containers, they stay.

    Args:
        hosts: On one network.
        folder: Where the kernel shows its limits.
    """
    wanted = {"gc_thresh3": 2 * hosts * hosts, "gc_thresh2": hosts * hosts, "gc_thresh1": hosts * hosts}
    before: dict[Path, str] = {}
    try:
        for name, least in wanted.items():
            path = folder / name
            value = path.read_text(encoding="ascii")
            if int(value) < least:
                path.write_text(str(least), encoding="ascii")
                before[path] = value
    except (OSError, ValueError):
        pass
    try:
        yield
    finally:
        for path, value in reversed(before.items()):
            path.write_text(value, encoding="ascii")
