"""Reads and judges the clock, the rights, the limits and the ROS environment of this machine.

Reads the clock, the rights and the limits of this machine.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import resource
import shutil
import socket
import subprocess
import threading
import time
from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.limits import KIB
from rmpa.observe import limits
from rmpa.observe.peer_info import FAIL, OK, SKIPPED, WARN, Check, CheckLevel
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback
from rmpa.ros.http.rpc import call_api
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.process import REMEDY

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence


# Runs programs of the system, and asks the resolver, each with a time-out.


def ask_program(*words: str) -> str | None:
    """What a program prints; ``None`` if it is missing, fails, or takes more than ``limits.DOCTOR_PROGRAM``."""
    path = shutil.which(words[0], path="/usr/sbin:/sbin:/usr/bin:/bin")
    if path is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, and a program of the system's folders
            [path, *words[1:]],
            capture_output=True,
            timeout=limits.DOCTOR_PROGRAM,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout[: limits.DOCTOR_OUTPUT_MAX].decode("utf-8", "replace") if done.returncode == 0 else None


def resolve(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The IPv4 addresses of host names; none for a name that is not resolved within ``limits.DOCTOR_NAME``."""
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())

    def look(name: str) -> None:
        with contextlib.suppress(OSError, UnicodeError):
            found[name] = tuple(dict.fromkeys(str(a[4][0]) for a in socket.getaddrinfo(name, None, socket.AF_INET)))

    # The resolver cannot be interrupted: a thread that still waits ends with the program.
    threads = [threading.Thread(target=look, args=(name,), daemon=True) for name in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(limits.DOCTOR_NAME)
    return dict(found)


# Judges the machine: wall clock, rights for real time, limit of open files.


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


# Judges the ROS_* variables of a shell: whether nodes started in it find the module's core, and can be reached.


_CHECK: Final = "ROS"


@dataclass(frozen=True, slots=True)
class RosShell:
    """The variables of a shell, and the facts to judge them by.

    Args:
        environ: The variables.
        host_name: This machine's name.
        addresses: This machine's IPv4 addresses, 127.0.0.1 among them.
        resolved: The IPv4 addresses of the names of ``names_of``; empty for a name that is unknown.
        cores: The URI of each agent's core on this machine, by the agent's name.
        domains: The domain of each of these agents.
        answers: Whether connections to ROS_MASTER_URI are accepted; ``None`` if that was not tried.
        external: The roscore that an agent with these settings would use; empty where it has a core of its own.
    """

    environ: Mapping[str, str]
    host_name: str
    addresses: frozenset[str]
    resolved: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    cores: Mapping[str, str] = field(default_factory=dict)
    domains: Mapping[str, int] = field(default_factory=dict)
    answers: bool | None = None
    external: str = ""


def names_of(environ: Mapping[str, str], host_name: str) -> tuple[str, ...]:
    """The host names that must be resolved before a shell can be judged."""
    names = [host_of(environ.get("ROS_MASTER_URI", "")), environ.get("ROS_HOSTNAME", ""), host_name]
    return tuple(dict.fromkeys(name for name in names if name and not _is_address(name)))


def judge_shell(shell: RosShell) -> list[Check]:
    """The variables that would mislead a node or an agent started in this shell, and those that are right."""
    found = [*_master(shell), *_own_name(shell), *_domain(shell)]
    environ = shell.environ
    if environ.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0"):
        text = "is a variable of older ROS 2 and changes nothing here"
        remedy = "to keep an agent to this machine: ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or --interface lo"
        found.append(_check("ROS_LOCALHOST_ONLY", WARN, text, remedy))
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach in ("OFF", "LOCALHOST"):
        what = "sends no beacons at all" if reach == "OFF" else "looks for others on this machine only"
        text = f"{reach}: an agent that is started in this shell {what}"
        found.append(_check("ROS_AUTOMATIC_DISCOVERY_RANGE", WARN, text, "unset it, if that is not meant"))
    if environ.get("ROS_NAMESPACE", "").strip("/"):
        text = (
            f"nodes that are started in this shell, and their relative names, live below {environ['ROS_NAMESPACE']}"
        )
        found.append(_check("ROS_NAMESPACE", WARN, text, "unset it, if that is not meant"))
    return found


def _check(variable: str, level: CheckLevel, text: str, remedy: str = "") -> Check:
    return Check(_CHECK, level, text, remedy, where=variable)


def _is_address(host: str) -> bool:
    try:
        IPv4Address(host)
    except AddressValueError:
        return False
    return True


def _addresses(shell: RosShell, host: str) -> tuple[str, ...]:
    return (host,) if _is_address(host) else shell.resolved.get(host, ())


def _is_here(shell: RosShell, addresses: tuple[str, ...]) -> bool:
    return bool(addresses) and all(address in shell.addresses or is_loopback(address) for address in addresses)


def _master(shell: RosShell) -> list[Check]:
    """ROS_MASTER_URI: where nodes of this shell look for their master."""
    variable = "ROS_MASTER_URI"
    given = shell.environ.get(variable, "")
    try:
        uri = RosEnvironment.read({variable: given}).master_uri
    except ConfigError as error:
        return [_check(variable, FAIL, error.problem, error.remedy)]
    host, port = host_of(uri), uri.rstrip("/").rpartition(":")[2]
    said = given or f"{DEFAULT_MASTER_URI} (it is not set)"
    ours = [name for name, core in shell.cores.items() if core.rstrip("/").rpartition(":")[2] == port]
    addresses = _addresses(shell, host)
    export = next((f"export ROS_MASTER_URI={core}" for core in shell.cores.values()), "unset ROS_MASTER_URI")
    if any(core.rstrip("/") == uri.rstrip("/") for core in shell.cores.values()):
        return [_check(variable, OK, f"{said} is the core of {ours[0]}" if ours else said)]
    if shell.external and shell.external.rstrip("/") == uri.rstrip("/"):
        if shell.answers:
            return [_check(variable, OK, f"{said} is the roscore that `rmpa up` will use")]
        text = f"{said} does not answer, and is the roscore that `rmpa up` should use"
        return [_check(variable, WARN, text, "start it: roscore")]
    if host != "localhost" and not addresses:
        text = f"{said}: the name {host} cannot be resolved, so nodes of this shell find no master"
        return [_check(variable, FAIL, text, export)]
    if host != "localhost" and not _is_here(shell, addresses):
        text = (
            f"{said} is another machine ({addresses[0]}): nodes of this shell join its graph, and this module's not"
        )
        return [_check(variable, FAIL, text, export)]
    if ours:
        return [_check(variable, OK, f"{said} is the core of {ours[0]}")]
    if shell.cores:
        listed = ", ".join(f"{name}'s is {core}" for name, core in shell.cores.items())
        text = f"{said} is not the core of an agent here ({listed})"
        return [_check(variable, WARN, text, export)]
    if shell.answers:
        text = f"{said} answers, but no agent of ours runs here"
        return [_check(variable, WARN, text, "end that roscore before `rmpa up`, or let it be the agent's")]
    return [_check(variable, OK, f"{said}: no master answers there yet; `rmpa up` will be there")]


def _own_name(shell: RosShell) -> list[Check]:
    """ROS_HOSTNAME and ROS_IP: the name under which nodes of this shell are to be reached."""
    host_name, ip = shell.environ.get("ROS_HOSTNAME", ""), shell.environ.get("ROS_IP", "")
    found = []
    if host_name and ip and host_name != ip:
        text = f"both are set, and ROS_HOSTNAME={host_name} counts"
        found.append(_check("ROS_IP", WARN, text, "unset one of them"))
    variable, value = ("ROS_HOSTNAME", host_name) if host_name else ("ROS_IP", ip)
    loopback = "export ROS_IP=127.0.0.1 (nodes talk over loopback; the agent carries what is for others)"
    if not value:
        return [*found, _host_name(shell, loopback)]
    if "://" in value:
        return [*found, _check(variable, FAIL, f"{value} is a URI", f"the host alone; or {loopback}")]
    if variable == "ROS_IP" and not _is_address(value):
        return [*found, _check(variable, FAIL, f"{value} is no IPv4 address", loopback)]
    addresses = _addresses(shell, value)
    if value != "localhost" and not addresses:
        text = f"the name {value} cannot be resolved: other nodes of this machine cannot reach those of this shell"
        return [*found, _check(variable, FAIL, text, loopback)]
    if value != "localhost" and not _is_here(shell, addresses):
        have = ", ".join(sorted(shell.addresses))
        text = f"{value} is not an address of this machine (it has {have}): nodes of this shell cannot be reached"
        return [*found, _check(variable, FAIL, text, loopback)]
    return [*found, _check(variable, OK, f"{value} is this machine")]


def _host_name(shell: RosShell, remedy: str) -> Check:
    """Without those variables nodes are to be reached under the host's name."""
    name = shell.host_name
    addresses = shell.resolved.get(name, ())
    if name == "localhost":
        return _check("host name", OK, "nodes are reached by this machine's address")
    if not addresses:
        text = f"nodes tell others to reach them at {name}, and that name cannot be resolved"
        return _check("host name", FAIL, text, f"put '127.0.1.1 {name}' into /etc/hosts, or {remedy}")
    if not _is_here(shell, addresses):
        text = f"nodes tell others to reach them at {name}, which is said to be {addresses[0]}: not this machine"
        return _check("host name", FAIL, text, f"correct /etc/hosts, or {remedy}")
    return _check("host name", OK, f"{name} is this machine ({addresses[0]})")


def _domain(shell: RosShell) -> list[Check]:
    given = shell.environ.get("ROS_DOMAIN_ID", "")
    if not given:
        return []
    if not given.isdecimal() or int(given) > core_limits.DOMAIN_MAX:
        text = f"{given!r} is not a domain: `rmpa up` will refuse it"
        return [_check("ROS_DOMAIN_ID", FAIL, text, f"0 to {core_limits.DOMAIN_MAX}")]
    others = [f"{name} is in {domain}" for name, domain in shell.domains.items() if domain != int(given)]
    if others:
        text = f"{given}, but {', '.join(others)}: agents of different domains do not see each other"
        return [_check("ROS_DOMAIN_ID", WARN, text, "start all modules of a robot with one domain")]
    return [_check("ROS_DOMAIN_ID", OK, given)]


_CALLER: Final = "/rmpa_doctor"

_UNSYNCHRONISED: Final = 0x40
"""STA_UNSYNC of adjtimex(2)."""


class _Timex(ctypes.Structure):
    """The beginning of ``struct timex`` (adjtimex(2)), with room for the rest of it."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def read_clock() -> WallClock:
    """Watch the wall clock for ``limits.DOCTOR_CLOCK_LOOK``, and ask the kernel whether it is synchronised."""
    before = time.time() - time.monotonic()
    time.sleep(limits.DOCTOR_CLOCK_LOOK)
    after = time.time() - time.monotonic()
    told = _Timex()
    try:
        answered: bool = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(told)) >= 0
    except (OSError, AttributeError):
        answered = False
    return WallClock(
        stepped=after - before,
        synchronised=not told.status & _UNSYNCHRONISED if answered else None,
        error=told.maxerror * 1e-6,
        year=time.gmtime().tm_year,
    )


def read_sim_time(core_uri: str) -> list[str] | None:
    """The nodes that publish ``/clock`` at a core with ``/use_sim_time``; ``None`` without, or if it is silent."""
    try:
        return asyncio.run(_clocks(core_uri))
    except (RmpaError, TimeoutError):
        return None


async def _clocks(core_uri: str) -> list[str] | None:
    async with asyncio.timeout(limits.DOCTOR_NODES_TIMEOUT):
        used = await call_api(core_uri, "getParam", _CALLER, "/use_sim_time")
        if used.code != 1 or not used.value:
            return None
        match (await call_api(core_uri, "getSystemState", _CALLER)).value:
            case [list(publishers), *_]:
                found = [row[1] for row in publishers if isinstance(row, list) and row[:1] == ["/clock"]]
                return [str(node) for nodes in found if isinstance(nodes, list) for node in nodes]
    return []


def probe_rights(*, wanted: bool, agents: bool) -> KernelRights:
    """Try SCHED_FIFO in a thread of its own, and read the limits.

    Args:
        wanted: Whether the settings ask for real time.
        agents: Whether an agent runs: its snapshot has its own limit of open files.
    """
    refusal = ["it was not tried"]

    def attempt() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
            refusal[0] = ""
        except OSError as error:
            refusal[0] = error.strerror or str(error)

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    memlock = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    free = memlock == resource.RLIM_INFINITY or _may_lock()
    return KernelRights(
        fifo=refusal[0],
        memlock=None if free else memlock,
        wanted=wanted,
        files=None if agents else runtime_limits.OPEN_FILES if files == resource.RLIM_INFINITY else files,
    )


def _may_lock() -> bool:
    """Whether this process has CAP_IPC_LOCK, which the limit of locked memory does not bind."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> 14 & 1)
    return False
