"""Judges the machine: clock, rights for real time, open files."""

from __future__ import annotations

from dataclasses import dataclass

from rmpa.core.sizes import KIB
from rmpa.observe import limits
from rmpa.observe.doctor.finding import Finding, FindingLevel


@dataclass(frozen=True, slots=True)
class WallClock:
    """What is known of the wall clock.

    Args:
        stepped: Seconds that it went apart from the monotonic one while it was looked at.
        synchronised: Whether the kernel is told that it follows another one (NTP); ``None`` if it does not tell.
        error: The bound of its error that the kernel was told, seconds.
        year: That it shows.
    """

    stepped: float
    synchronised: bool | None
    error: float
    year: int


def judge_clock(clock: WallClock) -> list[Finding]:
    """Whether stamps made here can be trusted."""
    found = []
    if clock.year < 2020:  # a board without a battery begins in 1970, or at its image's date
        text = f"it is the year {clock.year} here: this machine has no clock that outlives its power"
        found.append(Finding("clock", "date", FindingLevel.FAIL, text, "let chrony or systemd-timesyncd set it"))
    if abs(clock.stepped) > limits.DOCTOR_CLOCK_STEP:
        text = f"the wall clock was set by {clock.stepped * 1e3:+.1f} ms while we looked"
        remedy = "is something setting it again and again? one of chrony, ntpd and timesyncd alone, please"
        found.append(Finding("clock", "step", FindingLevel.WARN, text, remedy))
    else:
        found.append(Finding("clock", "step", FindingLevel.OK, "runs evenly"))
    if clock.synchronised is None:
        found.append(Finding("clock", "synchronised", FindingLevel.SKIPPED, "the kernel does not tell"))
    elif clock.synchronised:
        found.append(
            Finding("clock", "synchronised", FindingLevel.OK, f"within ±{clock.error * 1e3:.1f} ms, says the kernel")
        )
    else:
        text = "follows no other clock: stamps of this module drift from those of the others (tf: extrapolation)"
        remedy = "install chrony, and let all modules follow one of them; latencies are right all the same"
        found.append(Finding("clock", "synchronised", FindingLevel.WARN, text, remedy))
    return found


def judge_peer_clock(agent: str, peer: str, offset: float, error: float | None) -> Finding:
    """Whether two modules' clocks agree well enough for tf and for message filters."""
    subject = f"{agent}-{peer}"
    bound = f" ±{error * 1e3:.1f} ms" if error is not None else ""
    text = f"{peer}'s clock is {abs(offset) * 1e3:.1f} ms{bound} {'ahead of' if offset > 0 else 'behind'} ours"
    if abs(offset) - (error or 0.0) > limits.DOCTOR_CLOCK_APART:
        remedy = "let both follow one clock (chrony); until then tf says 'extrapolation into the future'"
        return Finding("clock", subject, FindingLevel.WARN, text, remedy)
    return Finding("clock", subject, FindingLevel.OK, text)


@dataclass(frozen=True, slots=True)
class KernelRights:
    """What this user may ask of the kernel.

    Args:
        fifo: Why SCHED_FIFO is refused, or empty.
        memlock: Bytes that may be locked; ``None`` for any number.
        wanted: Whether the settings ask for real time.
        files: Open files that a program started here may have at the most; ``None`` where agents run, which tell
            theirs.
    """

    fifo: str
    memlock: int | None
    wanted: bool
    files: int | None


def judge_rights(rights: KernelRights) -> list[Finding]:
    """Whether ``rmpa up --realtime`` would get what it asks for, and whether there are files enough."""
    missing = []
    if rights.fifo:
        missing.append(f"no SCHED_FIFO ({rights.fifo})")
    if rights.memlock is not None:
        missing.append(f"only {rights.memlock // KIB} KiB may be locked in memory")
    if not missing:
        found = [Finding("realtime", "", FindingLevel.OK, "SCHED_FIFO and locked memory are allowed")]
    else:
        remedy = (
            "systemd: LimitRTPRIO=50, LimitMEMLOCK=infinity; a log-in: 'USER - rtprio 50' and 'USER - memlock "
            "unlimited' in /etc/security/limits.d/rmpa.conf (docs/realtime.md)"
        )
        level = FindingLevel.WARN if rights.wanted else FindingLevel.OK
        asked = "" if rights.wanted else "; nobody asks for it (rmpa up --realtime)"
        found = [Finding("realtime", "", level, "; ".join(missing) + asked, remedy if rights.wanted else "")]
    if rights.files is None:
        return found
    if rights.files < limits.DOCTOR_FILES_LOW:
        text = f"an agent started here may have {rights.files} open: a graph of some hundred nodes takes more"
        remedy = "systemd: LimitNOFILE=65536; a log-in: 'USER - nofile 65536' in /etc/security/limits.d/rmpa.conf"
        found.append(Finding("files", "", FindingLevel.WARN, text, remedy))
    else:
        found.append(Finding("files", "", FindingLevel.OK, f"an agent started here may have {rights.files} open"))
    return found
