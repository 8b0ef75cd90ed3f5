"""Judges the ROS_* variables of a shell: whether nodes started in it find the module's core, and can be reached."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.errors import ConfigError
from rmpa.observe.check import FAIL, OK, WARN, Check, CheckLevel
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback

if TYPE_CHECKING:
    from collections.abc import Mapping

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
    if not given.isdecimal() or int(given) > limits.DOMAIN_MAX:
        text = f"{given!r} is not a domain: `rmpa up` will refuse it"
        return [_check("ROS_DOMAIN_ID", FAIL, text, f"0 to {limits.DOMAIN_MAX}")]
    others = [f"{name} is in {domain}" for name, domain in shell.domains.items() if domain != int(given)]
    if others:
        text = f"{given}, but {', '.join(others)}: agents of different domains do not see each other"
        return [_check("ROS_DOMAIN_ID", WARN, text, "start all modules of a robot with one domain")]
    return [_check("ROS_DOMAIN_ID", OK, given)]
