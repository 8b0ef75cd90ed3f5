"""Judges the machine: wall clock, rights for real time, limit of open files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.limits import KIB
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check
from rmpa.runtime.process import REMEDY

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class WallClock:
    """The state of the wall clock.

    Args:
        stepped: Seconds by which it moved against the monotonic clock while it was watched.
        synchronised: Whether it follows another clock (NTP), as the kernel says; ``None`` if it does not say.
        error: The bound of its error, as the kernel says; seconds.
        year: The year that it shows.
    """

    stepped: float
    synchronised: bool | None
    error: float
    year: int


def judge_clock(clock: WallClock) -> list[Check]:
    """Whether time stamps made here can be trusted."""
    found = []
    if clock.year < 2020:  # without a battery a board starts in 1970, or at its image's date
        text = f"it is the year {clock.year} here: this machine has no clock that outlives its power"
        found.append(Check("clock", FAIL, text, "let chrony or systemd-timesyncd set it", where="date"))
    if abs(clock.stepped) > limits.DOCTOR_CLOCK_STEP:
        text = f"the wall clock was set by {clock.stepped * 1e3:+.1f} ms while we looked"
        remedy = "is something setting it again and again? one of chrony, ntpd and timesyncd alone, please"
        found.append(Check("clock", WARN, text, remedy, where="step"))
    else:
        found.append(Check("clock", OK, "runs evenly", where="step"))
    if clock.synchronised is None:
        found.append(Check("clock", SKIPPED, "the kernel does not tell", where="synchronised"))
    elif clock.synchronised:
        found.append(Check("clock", OK, f"within ±{clock.error * 1e3:.1f} ms, says the kernel", where="synchronised"))
    else:
        text = "follows no other clock: stamps of this module drift from those of the others (tf: extrapolation)"
        remedy = "install chrony, and let all modules follow one of them; latencies are right all the same"
        found.append(Check("clock", WARN, text, remedy, where="synchronised"))
    return found


def judge_sim_time(agent: str, clocks: Sequence[str] | None) -> list[Check]:
    """Whether a module's simulated time runs.

    Args:
        agent: Its name.
        clocks: The nodes that publish ``/clock``; ``None`` if its ``/use_sim_time`` is not set.
    """
    where = f"simulated time of {agent}"
    if clocks is None:
        return []
    if clocks:
        return [Check("clock", OK, f"/clock comes from {', '.join(clocks)}", where=where)]
    text = "/use_sim_time is true, and no node publishes /clock: nodes that start stand still at time 0"
    return [Check("clock", WARN, text, "start the simulator, or `rosparam delete /use_sim_time`", where=where)]


def judge_peer_clock(agent: str, peer: str, offset: float, error: float | None) -> Check:
    """Whether two modules' clocks agree well enough for tf and message filters; both in seconds."""
    subject = f"{agent}-{peer}"
    bound = f" ±{error * 1e3:.1f} ms" if error is not None else ""
    text = f"{peer}'s clock is {abs(offset) * 1e3:.1f} ms{bound} {'ahead of' if offset > 0 else 'behind'} ours"
    if abs(offset) - (error or 0.0) > limits.DOCTOR_CLOCK_APART:
        remedy = "let both follow one clock (chrony); until then tf says 'extrapolation into the future'"
        return Check("clock", WARN, text, remedy, where=subject)
    return Check("clock", OK, text, where=subject)


@dataclass(frozen=True, slots=True)
class KernelRights:
    """What the kernel allows this user.

    Args:
        fifo: Why SCHED_FIFO is refused, or empty.
        memlock: Bytes that may be locked in memory; ``None`` for any number.
        wanted: Whether the settings ask for real time.
        files: Files that a program started here may open; ``None`` where an agent runs, whose snapshot has its own
            limit.
    """

    fifo: str
    memlock: int | None
    wanted: bool
    files: int | None


def judge_rights(rights: KernelRights) -> list[Check]:
    """Whether ``rmpa up --realtime`` would get what it asks for, and whether an agent may open enough files."""
    missing = []
    if rights.fifo:
        missing.append(f"no SCHED_FIFO ({rights.fifo})")
    if rights.memlock is not None:
        missing.append(f"only {rights.memlock // KIB} KiB may be locked in memory")
    if not missing:
        found = [Check("realtime", OK, "SCHED_FIFO and locked memory are allowed")]
    else:
        level = WARN if rights.wanted else OK
        asked = "" if rights.wanted else "; not asked for (rmpa up --realtime)"
        found = [Check("realtime", level, "; ".join(missing) + asked, REMEDY if rights.wanted else "")]
    if rights.files is None:
        return found
    if rights.files < limits.DOCTOR_FILES_LOW:
        text = f"an agent started here may have {rights.files} open: a graph of some hundred nodes takes more"
        remedy = "systemd: LimitNOFILE=65536; a log-in: 'USER - nofile 65536' in /etc/security/limits.d/rmpa.conf"
        found.append(Check("files", WARN, text, remedy))
    else:
        found.append(Check("files", OK, f"an agent started here may have {rights.files} open"))
    return found
