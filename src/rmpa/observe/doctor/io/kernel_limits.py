"""Reads the kernel's limits that a large mesh can reach, as they are for an agent of this machine."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.observe.doctor.kernel_limits import BACKLOG, MEMBERSHIPS, NEIGHBOURS, RECEIVE_BUFFER, KernelLimits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.observe.snapshot import Snapshot

_SYS: Final = Path("/proc/sys")
_CAP_NET_ADMIN: Final = 12
"""The bit of capabilities(7)."""


def read_kernel_limits(snapshots: Iterable[Snapshot]) -> KernelLimits:
    """Read the limits.

    Args:
        snapshots: Of the agents that run here; of several, the one with the fewest files counts. Without one, the
            limits are those of an agent that this user would start.
    """
    agents = [(shown.agent.files.limit, shown.agent.pid) for shown in snapshots if shown.agent.files is not None]
    free = all(_has_net_admin(str(pid)) for _, pid in agents) if agents else _has_net_admin("self")
    files, pid = min(agents) if agents else (None, None)
    if not agents and (hard := resource.getrlimit(resource.RLIMIT_NOFILE)[1]) != resource.RLIM_INFINITY:
        files = hard
    return KernelLimits(
        receive_buffer=None if free else read_setting(RECEIVE_BUFFER),
        backlog=read_setting(BACKLOG),
        neighbours=read_setting(NEIGHBOURS),
        memberships=read_setting(MEMBERSHIPS),
        files=files,
        pid=pid,
    )


def read_setting(name: str) -> int | None:
    """The value of a setting of the kernel by its name for sysctl(8); ``None`` where there is none."""
    try:
        return int((_SYS / name.replace(".", "/")).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def _has_net_admin(process: str) -> bool:
    """Whether a process has CAP_NET_ADMIN, which ``net.core.rmem_max`` does not bind; its id, or ``self``."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:
        return False
    fields = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
    return bool(int(fields.get("CapEff", "0").strip(), 16) >> _CAP_NET_ADMIN & 1)
