"""``rmpa init``: a first ``rmpa.toml``, with a value where this machine says one, and every other line a default."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
import textwrap
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import click

from rmpa.cli.options import Options, flag, json_verb
from rmpa.cli.output import Table, print_text, printable, warn, without_passwords
from rmpa.cli.units import CONFIG, config_text
from rmpa.config.module_name import kept_name, of_unit, state_dir
from rmpa.config.read import FILE_NAME, find_config_file, parse_config, ros_layer
from rmpa.config.settings import Settings, json_value, toml_value
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import peer_name_from
from rmpa.ros.types.installed import SearchPath

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.config.schema import Key
    from rmpa.discovery.network import Interface
    from rmpa.observe.snapshot import AgentInfo

_HEAD: Final = "# Written by `rmpa init`: the comment above each active line says what was found.\n"
_COLUMNS: Final = 118


class Finding(NamedTuple):
    """What was found for a setting.

    Attributes:
        key: The setting's key.
        text: What was found.
        value: What the setting gets; ``None``: it keeps its default.
    """

    key: Key
    text: str
    value: object = None


@json_verb(
    click.argument("file", required=False, metavar="[FILE]"),
    flag("--system", f"Write {CONFIG}, which the units of rmpa service read."),
    flag("--force", "Replace the file that is there."),
    flag("--dry-run", "Write nothing; print the file. FILE - means the same."),
)
def init(file: str | None, system: bool, force: bool, dry_run: bool, options: Options) -> None:
    """Write a first rmpa.toml, from what is found on this machine; the default of FILE is ./rmpa.toml.

    It looks at the host's name, the interfaces, the ROS variables of this shell, the agents and the roscore that
    run here, and the workspaces that are sourced. Each line with a value says above it what was found; all other
    lines are defaults in comments. Keys and passwords are never written.

    ---
    Under sudo the ROS variables of the shell are missing: sudo -E keeps them.

    Examples:
      rmpa init                    ./rmpa.toml, which rmpa up reads when it is started in this folder
      rmpa init -                  what would it have?
      rmpa init --json | jq .found
      sudo -E rmpa init --system && sudo systemctl restart rmpa
    """
    if system and file:
        raise ConfigError("--system", f"it writes {CONFIG}", "leave out FILE or --system")
    dry_run = dry_run or file == "-"
    path = Path(CONFIG if system else FILE_NAME if file in (None, "-") else str(file))
    notes: list[str] = []
    found = findings(os.environ, notes)
    text = file_text(found, system=system)
    parse_config(text.encode(), path)
    if not dry_run:
        _write(path, text, force=force, system=system)
        other = None if system else find_config_file(None, {**os.environ, "RMPA_CONFIG": ""}, path, [])
        notes += [f"{other} is not read where {path} is"] if other else []
    if options.as_json:
        shown = [{"setting": ".".join(key), "value": json_value(value), "found": said} for key, said, value in found]
        options.show({"file": str(path), "written": not dry_run, "found": shown, "notes": notes})
        return
    rows = [(".".join(key), "default" if value is None else toml_value(value), said) for key, said, value in found]
    if dry_run:
        click.echo(text, nl=False)
    else:
        print_text(Table("SETTING, VALUE, FOUND", rows))
        print_text(f"{path} is written. Next: {'sudo systemctl restart rmpa' if system else 'rmpa up'}")
    for note in notes:
        warn(note, "doubtful-setting")


def _write(path: Path, text: str, *, force: bool, system: bool) -> None:
    try:
        if system:
            path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        before = path.lstat() if force and os.path.lexists(path) else None
        if before and not stat.S_ISREG(before.st_mode):
            raise StartError(str(path), "is not a regular file", "name another one")
        new = path.with_name(f".{path.name}.{os.getpid()}") if before else path
        with new.open("x", encoding="utf-8") as file:
            try:
                if before:
                    with suppress(PermissionError):
                        os.fchown(file.fileno(), before.st_uid, before.st_gid)
                    os.fchmod(file.fileno(), stat.S_IMODE(before.st_mode))
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
                new.replace(path)
            except BaseException:
                new.unlink()
                raise
    except FileExistsError:
        raise StartError(str(path), "is there already", "--force replaces it, --dry-run prints a new one") from None
    except PermissionError:
        remedy = "sudo -E rmpa init --system" if system else "run it in a folder that you may write"
        raise StartError(str(path), "cannot be written by this user", remedy) from None
    except OSError as error:
        raise StartError(str(path), f"cannot be written: {error.strerror}") from None


def file_text(found: Sequence[Finding], *, system: bool = False) -> str:
    """The text of the file: every setting in a comment, with each finding above the first line of its key."""
    text = config_text() if system else config_text().replace("sudo systemctl reload rmpa", "rmpa reload")
    lines = (_HEAD + text).splitlines()
    for key, said, value in found:
        table = lines.index(f"[{'.'.join(key[:-1])}]") if key[1:] else 0
        at = next(number for number in range(table, len(lines)) if lines[number].startswith(f"# {key[-1]} = "))
        comment = textwrap.wrap(f"Found: {printable(said)}", _COLUMNS - 2, break_on_hyphens=False)
        line = [f"{key[-1]} = {toml_value(value)}"] if value is not None else []
        lines[at:at] = [*(f"# {each}" for each in comment), *line]
    return "\n".join(lines) + "\n"


def findings(environ: Mapping[str, str], notes: list[str]) -> list[Finding]:
    """What is found on this machine, in the order of the file.

    Args:
        environ: The shell's variables.
        notes: Gets what the user should know, and what no setting has.
    """
    from rmpa.discovery.network import read_interfaces

    host, agents = socket.gethostname(), list(_agents(environ, notes))
    directory = state_dir(of_unit(environ))
    kept = kept_name(directory)
    name = Finding(("name",), f"this host is called {host}", peer_name_from(host))
    if kept:
        name = Finding(("name",), f"it has had this name since its first start ({directory})", kept)
    said: list[str] = []
    layer = ros_layer(environ, host, said, external=False)
    notes += map(without_passwords, said)
    ros = [Finding(given.setting.key, f"{given.source} is set", given.read()) for given in layer.values()]
    port = layer["core_port"].read() if "core_port" in layer else Settings().core_port
    core = _core(agents, str(name.value), int(str(port)))
    found = {each.key: each for each in (*_interfaces(read_interfaces(())), *_workspaces(environ), *ros, name, *core)}
    if ("core", "mode") in found:
        found.pop(("core", "port"), None)  # of no use with an external core
    order = ["name", "domain", "core", "discovery", "web", "relay"]
    return sorted(found.values(), key=lambda each: order.index(each.key[0]))


def _agents(environ: Mapping[str, str], notes: list[str]) -> Iterator[AgentInfo]:
    from rmpa.observe import limits
    from rmpa.observe.control_client import ControlClient, find_agents

    for agent in find_agents(environ):
        try:
            with ControlClient(agent.path, limits.CONTROL_LOOK_TIMEOUT) as client:
                yield client.agent()
        except RmpaError as error:
            notes.append(f"the port of the agent {agent.name} is not known: {error}")


def _core(agents: Sequence[AgentInfo], name: str, port: int) -> Iterator[Finding]:
    """What has the core's port now: an agent, or a roscore, which the agent of this module can join."""
    from rmpa.agent.agent import is_other_master
    from rmpa.runtime.kernel_tcp import program_at

    ports = {int(agent.core_uri.rstrip("/").rpartition(":")[2]): agent for agent in agents}
    owner = ports.get(port)
    if running := [agent.pid for agent in agents if agent.name == name]:
        yield Finding(("name",), f"the agent {name} runs here (pid {running[0]}): end it before rmpa up", name)
    if owner is not None and owner.name != name:
        free = next(each for each in count(port + 1) if each not in ports)
        yield Finding(("core", "port"), f"the agent {owner.name} has port {port}, so this is a second module", free)
    if owner is None and asyncio.run(is_other_master(port)):
        holder = program_at(port).partition(" (")[0] or "a program"
        text = f'{holder} is the ROS master at port {port}, so the agent joins it; end it before you say "embedded"'
        yield Finding(("core", "mode"), text, "external")
        yield Finding(("core", "master"), "the master answers there", f"http://localhost:{port}/")


def _interfaces(there: Sequence[Interface]) -> Iterator[Finding]:
    from rmpa.discovery.network import CONTAINERS

    outer = [one for one in there if not one.loopback]
    inner = [one.name for one in outer if CONTAINERS.match(one.name) and one.networks]
    own = [one for one in outer if not CONTAINERS.match(one.name) and one.multicast]
    used = [f"{one.name} ({', '.join(map(str, one.networks))})" for one in own if one.used]
    text = f"{', '.join(used)} can be used" if used else "no network but loopback can be used at present"
    if inner:
        text += f"; left out: {', '.join(inner)} (containers, virtual machines). Add here what comes later"
    yield Finding(("discovery", "interfaces"), text, ("lo", *(one.name for one in own)) if inner and own else None)
    networks = {str(at.network): one.name for one in own if one.used for at in one.networks if not at.is_link_local}
    if len(networks) > 1:
        text = f"this machine is in {' and '.join(networks)}: true passes on what modules of one offer to the others"
        yield Finding(("relay", "enabled"), text)


def _workspaces(environ: Mapping[str, str]) -> Iterator[Finding]:
    """The agent needs no message definitions; the web server and the gateway read those of the variables."""
    path = SearchPath.read(environ)
    places = [place for place in (*path.packages, *path.prefixes) if not place.startswith("/opt/ros/")]
    if places:
        text = f"rmpa web reads messages of the workspaces {', '.join(dict.fromkeys(places))} if it is started here"
        yield Finding(("web", "enabled"), f"{text}; a unit of systemd needs ROS_PACKAGE_PATH in /etc/default/rmpa")
