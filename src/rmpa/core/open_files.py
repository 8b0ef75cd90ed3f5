"""The advice for a user whose limit of open files (file descriptors) is too low."""

from __future__ import annotations

from rmpa.core import limits


def remedy(pid: int | None = None) -> str:
    """How to raise the limit permanently; with a process id also how to raise it for that process at once."""
    enough = limits.OPEN_FILES_ADVICE
    text = (
        f"raise it: LimitNOFILE={enough} of a systemd unit, "
        f"`ulimit -n {enough}` as root in the shell that starts the agent"
    )
    if pid is not None:
        text += f", or at once, as root: prlimit --pid {pid} --nofile={enough}:{enough}"
    return text
