"""What a user does about a limit of open files (file descriptors) that is too low."""

from __future__ import annotations

from rmpa.core import limits


def remedy(pid: int | None = None) -> str:
    """How to raise the limit for good; with the process's id, how to raise it at once, too."""
    enough = limits.OPEN_FILES_ADVICE
    text = (
        f"raise it: LimitNOFILE={enough} of a systemd unit, "
        f"`ulimit -n {enough}` as root in the shell that starts the agent"
    )
    if pid is not None:
        text += f", or at once, as root: prlimit --pid {pid} --nofile={enough}:{enough}"
    return text
