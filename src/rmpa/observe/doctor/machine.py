"""Reads what several checks need, and judges the clock, the rights, the limits and the ROS environment."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import resource
import shutil
import socket
import struct
import subprocess
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core import limits as core_limits
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.limits import KIB, MIB
from rmpa.discovery.network import Interface, read_interfaces
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check, CheckLevel
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback, shown_uri
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.mirror import Survey, read_survey, survey_calls
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.loop import REALTIME_REMEDY
from rmpa.runtime.systemd import INSTALL, START, UNIT, is_set_up

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence


# The name under which a core is asked.
CALLER: Final = "/rmpa_doctor"


@dataclass(frozen=True, slots=True)
class DoctorInput:
    """What several checks need, read once.

    Args:
        environ: The shell's variables.
        settings: What an agent that is started here would have; the defaults where they cannot be read.
        settings_checks: The results of reading the settings.
        agents: The snapshot of each agent of this machine by its name, or why it does not answer.
        interfaces: All network interfaces.
        listen: Seconds to listen for multicast packets of other machines; 0: not at all.
    """

    environ: Mapping[str, str]
    settings: Settings
    settings_checks: tuple[Check, ...]
    agents: Mapping[str, Snapshot | str]
    interfaces: tuple[Interface, ...]
    listen: float = 0.0

    @property
    def snapshots(self) -> dict[str, Snapshot]:
        """Of the agents that answer."""
        return {name: shown for name, shown in self.agents.items() if isinstance(shown, Snapshot)}


def look_at(environ: Mapping[str, str], config: str | None = None, listen: float = 0.0) -> DoctorInput:
    """Read the settings and the interfaces, and ask the agents.

    Args:
        environ: The shell's variables.
        config: The settings' file; the usual places by default.
        listen: Seconds to listen for multicast packets of other machines.
    """
    try:
        loaded = load_settings({"config": config}, environ, host_name=socket.gethostname())
    except ConfigError as error:
        settings = Settings()
        checks = [Check("settings", FAIL, str(error), "`rmpa up` will not start", where=error.source)]
    else:
        settings = loaded.settings
        where = f"read from {settings.config_file}" if settings.config_file else "no file; defaults and variables"
        checks = [Check("settings", OK, f"{where}: name {settings.name}, domain {settings.domain}")]
        checks += [Check("settings", WARN, note, code="doubtful-setting") for note in loaded.notes]
    agents: dict[str, Snapshot | str] = {}
    for found in find_agents(environ):
        try:
            with ControlClient(found.path) as client:
                agents[found.name] = client.snapshot(most=0)  # topics in use
        except RmpaError as error:
            agents[found.name] = str(error)
    return DoctorInput(environ, settings, tuple(checks), agents, read_interfaces(settings.interfaces), listen)


def ask_program(*words: str) -> str | None:
    """What a program prints; ``None`` if it is missing, fails, or takes more than ``limits.DOCTOR_PROGRAM``."""
    path = shutil.which(words[0], path="/usr/sbin:/sbin:/usr/bin:/bin")
    if path is None:
        return None
    command, limit = [path, *words[1:]], limits.DOCTOR_PROGRAM
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, and a program of the system's folders
            command, capture_output=True, timeout=limit, check=True, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout[: 4 * MIB].decode("utf-8", "replace")  # the rules of a Kubernetes node have some 100 KB


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


# STA_UNSYNC of adjtimex(2).
_UNSYNCHRONISED: Final = 0x40


# The beginning of ``struct timex`` (adjtimex(2)): modes, offset, frequency, greatest and estimated error, status.
_TIMEX: Final = struct.Struct("@I4li")


def clocks(given: DoctorInput) -> Iterable[Check]:
    """The check of the wall clock, and of simulated time.

    The wall clock is watched for ``limits.DOCTOR_CLOCK_LOOK``, and the kernel is asked whether it is synchronised.
    """
    before = time.time() - time.monotonic()
    time.sleep(limits.DOCTOR_CLOCK_LOOK)
    stepped = time.time() - time.monotonic() - before
    timex, synchronised, error = ctypes.create_string_buffer(512), None, 0
    with contextlib.suppress(OSError, AttributeError):
        if ctypes.CDLL(None, use_errno=True).adjtimex(timex) >= 0:
            *_, error, _, status = _TIMEX.unpack_from(timex)
            synchronised = not status & _UNSYNCHRONISED
    yield from judge_clock(stepped, synchronised, error * 1e-6, time.gmtime().tm_year)
    for name, shown in given.snapshots.items():
        yield from judge_sim_time(name, read_sim_time(shown.agent.core_uri))


def judge_clock(stepped: float, synchronised: bool | None, error: float, year: int) -> Iterator[Check]:
    """Whether time stamps made here can be trusted.

    Args:
        stepped: Seconds by which the wall clock moved against the monotonic clock while it was watched.
        synchronised: Whether it follows another clock (NTP), as the kernel says; ``None`` if it does not say.
        error: The bound of its error, as the kernel says; seconds.
        year: The year that it shows.
    """
    clock = partial(Check, "clock")
    if year < 2020:  # without a battery a board starts in 1970, or at its image's date
        text = f"it is the year {year} here: this machine has no clock that outlives its power"
        yield clock(FAIL, text, "let chrony or systemd-timesyncd set it", where="date")
    if abs(stepped) > 0.005:  # slewing moves it by 0.15 ms
        text = f"the wall clock was set by {stepped * 1e3:+.1f} ms while we looked"
        remedy = "is something setting it again and again? one of chrony, ntpd and timesyncd alone, please"
        yield clock(WARN, text, remedy, where="step")
    else:
        yield clock(OK, "runs evenly", where="step")
    if synchronised is None:
        yield clock(SKIPPED, "the kernel does not say", where="synchronised")
    elif synchronised:
        yield clock(OK, f"within ±{error * 1e3:.1f} ms, says the kernel", where="synchronised")
    else:
        text = "follows no other clock: stamps of this module drift from those of the others (tf: extrapolation)"
        remedy = "install chrony, and let all modules follow one of them; latencies that RMPA shows are right anyway"
        yield clock(WARN, text, remedy, where="synchronised")


def judge_sim_time(agent: str, publishers: Sequence[str] | None) -> Iterator[Check]:
    """Whether a module's simulated time runs.

    Args:
        agent: Its name.
        publishers: The nodes that publish ``/clock``; ``None`` if its ``/use_sim_time`` is not set.
    """
    where = f"simulated time of {agent}"
    if publishers:
        yield Check("clock", OK, f"/clock comes from {', '.join(publishers)}", where=where)
    elif publishers is not None:
        text = "/use_sim_time is true, and no node publishes /clock: nodes that start stand still at time 0"
        yield Check("clock", WARN, text, "start the simulator, or `rosparam delete /use_sim_time`", where=where)


def read_sim_time(core_uri: str) -> list[str] | None:
    """The nodes that publish ``/clock`` at a core with ``/use_sim_time``; ``None`` without, or if it is silent."""
    try:
        return asyncio.run(_clock_publishers(core_uri))
    except (RmpaError, TimeoutError):
        return None


async def _clock_publishers(core_uri: str) -> list[str] | None:
    async with asyncio.timeout(limits.DOCTOR_NODES_TIMEOUT):
        used = await call_api(core_uri, "getParam", CALLER, "/use_sim_time")
        if used.code != 1 or not used.value:
            return None
        return [*(await survey(core_uri)).holders[RegistrationKind.PUBLISHER].get("/clock", ())]


async def survey(core_uri: str) -> Survey:
    """The graph of a core."""
    return read_survey(await call(core_uri, "system.multicall", survey_calls(CALLER, (), ())), (), ())


def read_unit() -> dict[str, str]:
    """What ``systemctl show`` says of the agent's unit; empty where there is no systemd."""
    properties = "--property=LoadState,ActiveState,UnitFileState,Result,FragmentPath"
    shown = ask_program("systemctl", "show", UNIT, properties) or ""
    return dict(line.partition("=")[::2] for line in shown.splitlines())


def judge_unit(unit: Mapping[str, str]) -> Check:
    """Whether the agent's unit starts it with the machine, by what ``systemctl show`` says of it."""
    if unit.get("LoadState") != "loaded":
        remedy = "sudo rmpa service install starts an agent with the machine"
        return Check("boot", SKIPPED, "rmpa.service is not installed", remedy)
    if unit["ActiveState"] == "failed":
        return Check("boot", FAIL, f"rmpa.service has failed ({unit['Result']})", "journalctl -u rmpa says why")
    if unit["UnitFileState"] != "enabled":
        text = f"rmpa.service is {unit['ActiveState']}, and does not start with the machine"
        return Check("boot", WARN, text, START if is_set_up(unit) else INSTALL)
    if unit["ActiveState"] == "inactive":
        text = "rmpa.service starts with the machine, and was stopped"
        return Check("boot", WARN, text, "sudo systemctl start rmpa")
    return Check("boot", OK, f"rmpa.service is {unit['ActiveState']}, and starts with the machine")


def rights(given: DoctorInput) -> Iterable[Check]:
    """The check of what the kernel allows this user. SCHED_FIFO is tried in a thread of its own."""
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
    return judge_rights(
        refusal[0],
        None if memlock == resource.RLIM_INFINITY or _may_lock() else memlock,
        None if given.snapshots else runtime_limits.OPEN_FILES if files == resource.RLIM_INFINITY else files,
        wanted=given.settings.realtime.enabled,
    )


def _may_lock() -> bool:
    """Whether this process has CAP_IPC_LOCK, which the limit of locked memory does not bind."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> 14 & 1)
    return False


def judge_rights(fifo: str, memlock: int | None, files: int | None, *, wanted: bool) -> Iterator[Check]:
    """Whether ``rmpa up --realtime`` would get what it asks for, and whether an agent may open enough files.

    Args:
        fifo: Why SCHED_FIFO is refused, or empty.
        memlock: Bytes that may be locked in memory; ``None`` for any number.
        files: Files that a program started here may open; ``None`` where an agent runs, whose snapshot has its own
            limit.
        wanted: Whether the settings ask for real time.
    """
    missing = [f"no SCHED_FIFO ({fifo})"] if fifo else []
    missing += [f"only {memlock // KIB} KiB may be locked in memory"] if memlock is not None else []
    if not missing:
        yield Check("realtime", OK, "SCHED_FIFO and locked memory are allowed")
    elif wanted:
        yield Check("realtime", WARN, "; ".join(missing), REALTIME_REMEDY)
    else:
        yield Check("realtime", OK, f"{'; '.join(missing)}; not asked for (rmpa up --realtime)")
    # Each subscriber takes one, and a proxy two where proxies cannot share their sockets.
    if files is not None and files < 4096:
        text = f"an agent started here may have {files} open: a graph of some hundred nodes takes more"
        remedy = "systemd: LimitNOFILE=65536; a log-in: 'USER - nofile 65536' in /etc/security/limits.d/rmpa.conf"
        yield Check("files", WARN, text, remedy)
    elif files is not None:
        yield Check("files", OK, f"an agent started here may have {files} open")


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

    def addresses_of(self, host: str) -> tuple[str, ...]:
        """The IPv4 addresses of a host."""
        return (host,) if _is_address(host) else self.resolved.get(host, ())

    def is_here(self, host: str) -> bool:
        """Whether a host is this machine."""
        known = self.addresses_of(host)
        return bool(known) and all(address in self.addresses or is_loopback(address) for address in known)


def shell(given: DoctorInput) -> Iterable[Check]:
    """The check of the shell's ROS_* variables."""
    host_name, settings = socket.gethostname(), given.settings
    own = {str(of.ip) for interface in given.interfaces for of in interface.networks}
    uri = given.environ.get("ROS_MASTER_URI", "") or DEFAULT_MASTER_URI
    try:
        at = host_of(uri), int(uri.rstrip("/").rpartition(":")[2])
        socket.create_connection(at, limits.CONTROL_LOOK_TIMEOUT).close()
        answers = True
    except (OSError, ValueError, OverflowError):
        answers = False
    facts = RosShell(
        environ=given.environ,
        host_name=host_name,
        addresses=frozenset({*own, "127.0.0.1"}),
        resolved=resolve(names_of(given.environ, host_name)),
        cores={name: snapshot.agent.core_uri for name, snapshot in given.snapshots.items()},
        domains={name: snapshot.agent.domain for name, snapshot in given.snapshots.items()},
        answers=answers,
        external=(settings.core_master or DEFAULT_MASTER_URI) if settings.core_mode == "external" else "",
    )
    return judge_shell(facts)


def names_of(environ: Mapping[str, str], host_name: str) -> tuple[str, ...]:
    """The host names that must be resolved before a shell can be judged."""
    names = [host_of(environ.get("ROS_MASTER_URI", "")), environ.get("ROS_HOSTNAME", ""), host_name]
    return tuple(dict.fromkeys(name for name in names if name and not _is_address(name)))


def _is_address(host: str) -> bool:
    try:
        IPv4Address(host)
    except AddressValueError:
        return False
    return True


def judge_shell(shell: RosShell) -> Iterator[Check]:
    """The variables that would mislead a node or an agent started in this shell, and those that are right."""
    environ, unset = shell.environ, "unset it, if that is not meant"
    yield _variable("ROS_MASTER_URI", *_master(shell))
    yield from _own_name(shell)
    yield from _domain(shell)
    if environ.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0"):
        text = "is a variable of older ROS 2 and changes nothing here"
        remedy = "to keep an agent to this machine: ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or --interface lo"
        yield _variable("ROS_LOCALHOST_ONLY", WARN, text, remedy)
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach in ("OFF", "LOCALHOST"):
        what = "sends no beacons at all" if reach == "OFF" else "looks for others on this machine only"
        text = f"{reach}: an agent that is started in this shell {what}"
        yield _variable("ROS_AUTOMATIC_DISCOVERY_RANGE", WARN, text, unset)
    if (namespace := environ.get("ROS_NAMESPACE", "")).strip("/"):
        text = f"nodes that are started in this shell, and their relative names, live below {namespace}"
        yield _variable("ROS_NAMESPACE", WARN, text, unset)


def _variable(name: str, level: CheckLevel, text: str, remedy: str = "") -> Check:
    return Check("ROS", level, text, remedy, where=name)


def _master(shell: RosShell) -> tuple[Any, ...]:
    """ROS_MASTER_URI: where nodes of this shell look for their master."""
    given = shell.environ.get("ROS_MASTER_URI", "")
    try:
        uri = RosEnvironment.read({"ROS_MASTER_URI": given}).master_uri.rstrip("/")
    except ConfigError as error:
        return FAIL, error.problem, error.remedy
    host, port = host_of(uri), uri.rpartition(":")[2]
    said = given or f"{DEFAULT_MASTER_URI} (it is not set)"
    cores = {name: core.rstrip("/") for name, core in shell.cores.items()}
    ours = [name for name, core in cores.items() if core.rpartition(":")[2] == port]
    core = next(map(shown_uri, shell.cores.values()), DEFAULT_MASTER_URI)
    export = f"export ROS_MASTER_URI={core}"
    if core == DEFAULT_MASTER_URI:
        export += ", also in ~/.bashrc"
    if uri not in cores.values():
        if shell.external.rstrip("/") == uri and shell.answers:
            return OK, f"{said} is the roscore that `rmpa up` will use"
        if shell.external.rstrip("/") == uri:
            return WARN, f"{said} does not answer, and is the roscore that `rmpa up` should use", "start it: roscore"
        if host != "localhost" and not shell.addresses_of(host):
            text = f"{said}: the name {host} cannot be resolved, so nodes of this shell find no master"
            return FAIL, text, export
        if host != "localhost" and not shell.is_here(host):
            text = f"{said} is another machine ({shell.addresses_of(host)[0]}): "
            return FAIL, text + "nodes of this shell use the ROS master there, and not that of this module", export
    if ours:
        return OK, f"{said} is the core of {ours[0]}"
    if shell.cores:
        listed = ", ".join(f"{name}'s is {shown_uri(core)}" for name, core in shell.cores.items())
        return WARN, f"{said} is not the core of an agent here ({listed})", export
    if shell.answers:
        remedy = "end that roscore before `rmpa up`, or let it be the agent's"
        return WARN, f"{said} answers, but no agent of ours runs here", remedy
    return OK, f"{said}: no master answers there yet; `rmpa up` will be there"


def _own_name(shell: RosShell) -> Iterator[Check]:
    """ROS_HOSTNAME and ROS_IP: the name under which nodes of this shell are to be reached."""
    host_name, ip = shell.environ.get("ROS_HOSTNAME", ""), shell.environ.get("ROS_IP", "")
    if host_name and ip and host_name != ip:
        text = f"both are set, and ROS_HOSTNAME={host_name} counts"
        yield _variable("ROS_IP", WARN, text, "unset one of them")
    named = partial(_variable, "ROS_HOSTNAME" if host_name else "ROS_IP")
    value, known = host_name or ip, shell.addresses_of(host_name or ip)
    loopback = "export ROS_IP=127.0.0.1 (nodes talk over loopback; the agent carries what is for others)"
    if not value:
        yield _variable("host name", *_host_name(shell, loopback))
    elif "://" in value:
        yield named(FAIL, f"{value} is a URI", f"the host alone; or {loopback}")
    elif not host_name and not _is_address(value):
        yield named(FAIL, f"{value} is no IPv4 address", loopback)
    elif value != "localhost" and not known:
        text = f"the name {value} cannot be resolved: other nodes of this machine cannot reach those of this shell"
        yield named(FAIL, text, loopback)
    elif value != "localhost" and not shell.is_here(value):
        have = ", ".join(sorted(shell.addresses))
        text = f"{value} is not an address of this machine (it has {have}): nodes of this shell cannot be reached"
        yield named(FAIL, text, loopback)
    else:
        yield named(OK, f"{value} is this machine")


def _host_name(shell: RosShell, remedy: str) -> tuple[Any, ...]:
    """Without those variables nodes are to be reached under the host's name."""
    name, addresses = shell.host_name, shell.resolved.get(shell.host_name, ())
    begin = f"nodes register with the host name {name}"
    if name == "localhost":
        return OK, "nodes are reached by this machine's address"
    if not addresses:
        remedy = f"put '127.0.1.1 {name}' into /etc/hosts, or {remedy}"
        return FAIL, f"{begin}, and that name cannot be resolved", remedy
    if not shell.is_here(name):
        text = f"{begin}, which resolves to {addresses[0]}: not this machine"
        return FAIL, text, f"correct /etc/hosts, or {remedy}"
    return OK, f"{name} is this machine ({addresses[0]})"


def _domain(shell: RosShell) -> Iterator[Check]:
    given = shell.environ.get("ROS_DOMAIN_ID", "")
    if given and (not given.isdecimal() or int(given) > core_limits.DOMAIN_MAX):
        text = f"{given!r} is not a domain: `rmpa up` will refuse it"
        yield _variable("ROS_DOMAIN_ID", FAIL, text, f"0 to {core_limits.DOMAIN_MAX}")
    elif others := [f"{name} is in {at}" for name, at in shell.domains.items() if given and at != int(given)]:
        text = f"{given}, but {', '.join(others)}: agents of different domains do not see each other"
        yield _variable("ROS_DOMAIN_ID", WARN, text, "start all modules of a robot with one domain")
    elif given:
        yield _variable("ROS_DOMAIN_ID", OK, given)
