"""``rmpa service install``, ``status`` and ``uninstall``: the agent at boot, by units of systemd."""

from __future__ import annotations

import os
import pwd
import re
import socket
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.options import Options, flag, json_verb, option
from rmpa.cli.output import Text, confirm
from rmpa.cli.units import (
    CONFIG,
    DROP_INS,
    GROUP,
    PACKAGED,
    RUNTIME,
    STATE,
    UNIT_FOLDER,
    UNITS,
    USER,
    Machine,
    config_text,
    copy_state,
    drop_in_text,
    own_program,
    refused,
    unit_texts,
)
from rmpa.config.module_name import (
    GATEWAY_SUFFIX,
    PLACES_FILE,
    NameSource,
    choose_name,
    keep_name,
    kept_name,
    module_dir,
    state_dir,
)
from rmpa.config.read import load_settings, parse_config
from rmpa.config.settings import Settings
from rmpa.config.toml_file import line_of
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import peer_name_from, peer_name_problem
from rmpa.runtime.systemd import INSTALL, is_set_up

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence


# The first line of each file that ``install`` makes: ``uninstall`` removes no other.
_MARK: Final = "# Made by `rmpa service install`; changes belong into a drop-in: systemctl edit {unit}\n"
# Behind the name of a unit that was written by hand, and is kept beside ours.
_BY_HAND: Final = ".by-hand"
# The states of a unit that does nothing, or is not there.
_AWAY: Final = ("inactive", "unknown")
# The accounts of the units, in the order in which they are made, with the words of ``groupadd`` and ``useradd``.
_ACCOUNTS: Final = (
    ("group", GROUP, ("--system", GROUP)),
    (
        *("user", USER),
        ("--system", "--gid", GROUP, "--home-dir", STATE, "--no-create-home", "--shell", "/usr/sbin/nologin", USER),
    ),
)
# A user without any rights of its own: what it cannot run, the unit's user cannot either.
_NOBODY: Final = 65534


@dataclass(frozen=True, slots=True)
class Former:
    """What the agent of a user has had until now.

    Args:
        user: The user.
        config: Its ``rmpa.toml`` in its home; ``None``: it has none.
        state: Its state directory; ``None``: nothing is in it.
        name: The name of its module; empty: the host's name.
        settings: Its settings.
    """

    user: str
    config: Path | None
    state: Path | None
    name: str
    settings: Settings = field(repr=False)


def former(environ: Mapping[str, str], root: str = "") -> Former:
    """What the user has who called ``sudo``, else root. A system below a folder is another machine: it has nothing.

    Raises:
        ConfigError: The user's rmpa.toml cannot be used.
    """
    if root:
        return Former("", None, None, "", Settings())
    caller = environ.get("SUDO_UID", "")
    user = pwd.getpwuid(int(caller) if caller.isdecimal() else os.geteuid())
    home = {"HOME": user.pw_dir, "SUDO_UID": caller}
    loaded = load_settings({}, home, host_name=socket.gethostname(), cwd=Path("/"))
    chosen = choose_name(loaded.names)
    config = loaded.settings.config_file
    state = state_dir(home, loaded.settings.state_dir)
    return Former(
        user.pw_name,
        config if config is not None and str(config) != CONFIG else None,
        state if state is not None and str(state) != STATE and _entries(state) else None,
        chosen.name if chosen.source is not NameSource.DEFAULT else "",
        loaded.settings,
    )


def choose_user(program: str) -> str:
    """The user of the units: one of their own if it can run the program, else the owner of the program.

    Raises:
        StartError: Only root can run it.
    """
    if _runs_as(program, _NOBODY, _NOBODY):
        return USER
    owner = Path(program).resolve().stat().st_uid
    if owner == 0:
        remedy = "install it elsewhere, such as in /opt/rmpa; or --user root"
        raise refused("install", f"other users than root cannot run {program}", remedy)
    return pwd.getpwuid(owner).pw_name


def _runs_as(program: str, uid: int, gid: int) -> bool:
    """Whether a user can run a program, and read all that it imports."""
    if os.geteuid():
        return True  # root alone can try
    command = [program, "--version"]
    try:
        done = subprocess.run(  # noqa: S603 - our own program
            command, user=uid, group=gid, extra_groups=[], cwd="/", capture_output=True, check=False
        )
    except OSError:
        return False
    return not done.returncode


@json_verb(
    flag("--web", "The web server too: rmpa web, in a unit of its own."),
    flag("--gateway", "The gateway too, with [gateway] of /etc/rmpa/rmpa.toml."),
    flag("--realtime", "Let the agent have real-time priority and locked memory."),
    flag("--resources", "Let nodes that the agent starts use devices, and go on without it."),
    option("--name", "NAME", "The module's name. [default: the one that it has had]"),
    option("--user", "NAME", "The user that the units run as. [default: rmpa, which is made]"),
    flag("--dry-run", "Change nothing; say what would be done, and print the units."),
    option("--root", "DIR", "The folder of another system, such as an image.", default=""),
)
def service_install(
    web: bool,
    gateway: bool,
    realtime: bool,
    resources: bool,
    name: str | None,
    user: str | None,
    dry_run: bool,
    root: str,
    options: Options,
) -> int:
    """Start the agent at boot, and now: by a unit of systemd, as a user of its own.

    The module's name, its keys and its state are copied from the state directory of the user who calls sudo;
    /etc/rmpa/rmpa.toml is made if it is missing. Other options of rmpa up are not copied: write them into that file
    first. Only the units are overwritten; a second call changes nothing.

    ---
    Where the program is in a home directory that other users cannot read, the units run as its owner.
    Members of the group rmpa may use rmpa's commands: sudo usermod -aG rmpa USER.

    Exit codes: 0 it runs; 1 it does not, with the reason on stderr; 2 a wrong option or setting.

    Examples:
      sudo rmpa service install --name base
      sudo rmpa service install --web --realtime
      sudo rmpa service install --resources        it starts drivers of cameras and motors
      rmpa service install --dry-run               what would be done?
      sudo rmpa service install --root /mnt/image  for a machine that is not running
    """
    root = root.rstrip("/")
    machine = Machine(root, dry=dry_run, tell=(lambda _: None) if options.as_json else click.echo)
    machine.check("install")
    if name and (problem := peer_name_problem(name)):
        raise ConfigError("--name", problem)
    program = own_program()
    before = former(os.environ, root)
    packaged = program == PACKAGED and machine.has_packaged()
    if packaged and user:
        raise ConfigError("--user", "the package's units have the user rmpa", "change it by: systemctl edit rmpa")
    wanted = [UNITS["up"], *([UNITS["web"]] if web else []), *([UNITS["gateway"]] if gateway else [])]
    if re.search(r"[\x00-\x1f\x7f'\"\\]", program):
        raise refused("install", f"systemd cannot start {program!r}", "install it elsewhere")
    for unit in wanted:
        machine.check_unmasked(unit)
    _check_parts(machine, before, web=web, gateway=gateway)  # reads the settings: below they are sound
    if name:
        _check_name(machine, before, name)
    if user is None:
        user = USER if root or packaged else choose_user(program)
        if user != USER:
            machine.tell(f"the units run as {user}: no other user can run {program}")
    _make_accounts(machine, user)
    _make_config(machine, before)
    renamed = _take_over(machine, before, user, name)
    # Units that were made for another program would hide the package's.
    changed = _remove_made(machine, UNITS.values()) if packaged else _write_units(machine, wanted, program, user)
    for way in [*(["realtime"] if realtime else []), *(["resources"] if resources else [])]:
        if machine.write(f"{UNIT_FOLDER}/{DROP_INS[way]}", drop_in_text(way, _MARK.format(unit=UNITS["up"]))):
            changed.append(UNITS["up"])
    if renamed:
        changed.extend(wanted)
    _start(machine, wanted, changed)
    if not (dry_run or root):
        machine.tell("it runs, now and at boot: `rmpa service status`; its log: journalctl -u rmpa")
    options.show({"units": wanted, "user": user, "changes": machine.changes, "dry_run": dry_run})
    return 0


def _check_name(machine: Machine, before: Former, name: str) -> None:
    """Check that ``--name`` says no other name than the settings, which outweigh the name that is kept.

    Raises:
        ConfigError: It does; with the line of the settings.
    """
    path = machine.path(CONFIG)
    config = path if path.is_file() else before.config
    if config is None:
        return
    data = config.read_bytes()
    said = parse_config(data, config).get(("name",))
    if said not in (None, name):
        problem, line = f"{said} outweighs --name {name}", line_of(data.decode("utf-8-sig"), ("name",))
        raise ConfigError("name", problem, "write it there, or remove the line", config, line)


def _check_parts(machine: Machine, before: Former, *, web: bool, gateway: bool) -> None:
    """Check that what is to start has a chance to.

    Raises:
        RmpaError: A library or a setting is missing, or another program has the core's port.
    """
    from rmpa.cli.module import check_gateway, check_web

    path = machine.path(CONFIG)
    settings = before.settings
    if path.is_file():
        settings = load_settings({"config": str(path)}, {}, host_name=socket.gethostname()).settings
    if web:
        check_web()
        if settings.web.enabled:
            raise ConfigError("--web", "[web] enabled = true in rmpa.toml has the agent start it", "choose one")
    if gateway:
        check_gateway(settings)
    if machine.root or settings.core_mode != "embedded" or machine.shown(UNITS["up"]).get("ActiveState") == "active":
        return
    from rmpa.runtime.kernel_tcp import program_at

    if holder := program_at(settings.core_port):
        problem = f"{holder} has port {settings.core_port}, which the agent's core needs"
        if not machine.dry:
            raise refused("install", problem, "end it first")
        machine.tell(f"! {problem}: end it first")


def _make_accounts(machine: Machine, user: str) -> None:
    for kind, name, words in _ACCOUNTS:
        if kind == "user" and user != USER:
            if not machine.root and machine.number(kind, user) is None:
                raise ConfigError("--user", f"there is no user {user}", "leave it out, and the user rmpa is made")
        elif machine.number(kind, name) is None:
            machine.run(f"make the {kind} {name}", f"{kind}add", *words)


def _make_config(machine: Machine, before: Former) -> None:
    if machine.path(CONFIG).exists():
        machine.tell(f"{CONFIG} stays as it is")
        if before.config is not None:
            machine.tell(f"! {before.config} is not read by the units")
        return
    text, source = config_text(), "every setting in a comment"
    if before.config is not None:
        text, source = before.config.read_text("utf-8"), f"as {before.config}"
    if machine.change(f"write {CONFIG}: {source}"):
        machine.path(CONFIG).parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        machine.path(CONFIG).write_text(text, "utf-8")
        machine.path(CONFIG).chmod(0o644)


def _entries(state: Path) -> list[Path]:
    """What a state directory keeps of modules."""
    return sorted(path for path in state.glob("*") if path.name != PLACES_FILE)


def _modules_in(state: Path, module: str, *, insecure: bool) -> tuple[dict[str, str], list[str]]:
    """The folders of a state directory: those of a module and its gateway, with what is said of them; and others.

    Args:
        state: The directory.
        module: The module.
        insecure: Whether it may be without keys although others have some.

    Raises:
        StartError: It may not.
    """
    wanted = {module_dir(state, each) for each in (module, module + GATEWAY_SUFFIX)}
    folders = [path for path in _entries(state) if path.is_dir() and not path.is_symlink()]
    keys = {path: (path / "trust").is_dir() for path in folders}
    others = [path.name for path in folders if path not in wanted]
    secured = [path.name for path in folders if keys[path] and path not in wanted]
    if secured and not keys.get(module_dir(state, module)) and not insecure:
        problem = f"it has no keys in {state}, but {', '.join(secured)} has"
        remedy = f"install that one, --name {secured[0]}; or first: rmpa trust join --name {module} TOKEN"
        raise StartError(f"the module {module}", problem, remedy, code="keys-unusable")
    ours = [path for path in folders if path in wanted]
    return {path.name: f"{path.name}/{' with keys of a secured mesh' if keys[path] else ''}" for path in ours}, others


def _take_over(machine: Machine, before: Former, user: str, name: str | None) -> bool:
    """Give the units what the user's agent has kept, unless they have kept something themselves; and the name.

    Returns:
        Whether the module has another name now.
    """
    place = machine.path(STATE)
    kept = kept_name(place)
    ids = None if machine.dry or os.geteuid() else machine.ids(user)
    if _entries(place):
        machine.tell(f"{STATE} stays as it is")
    elif before.state is not None:
        module = name or kept_name(before.state) or before.name or peer_name_from(socket.gethostname())
        ours, others = _modules_in(before.state, module, insecure=before.settings.trust.insecure)
        if others:
            machine.tell(f"what other modules have kept stays in {before.state}: {', '.join(others)}")
        if ours or not others:
            kept = kept_name(before.state)
            what = ", ".join([*([f"the name {kept}"] if kept else []), *ours.values()])
            if machine.change(f"copy what {before.user}'s agent has kept in {before.state}: {what}"):
                copy_state(before.state, place, ids, others)
    wanted = name or kept or before.name
    if not wanted or wanted == kept:
        return False
    if machine.change(f"keep the name {wanted}"):
        if not place.is_dir():
            place.mkdir(mode=0o700, parents=True)
            if ids is not None:
                os.chown(place, *ids)
        keep_name(place, wanted, instead=True)
    return True


def _write_units(machine: Machine, wanted: Sequence[str], program: str, user: str) -> list[str]:
    """Write the units; return those whose text has changed. One that was written by hand is renamed, not replaced."""
    texts = unit_texts(program, user)
    for unit in wanted:
        path = machine.unit(unit)
        old = f"{unit}{_BY_HAND}"
        if path.is_file() and not _is_made(path) and machine.change(f"rename {UNIT_FOLDER}/{unit} to {old}"):
            path.rename(path.with_name(old))
    return [unit for unit in wanted if machine.write(f"{UNIT_FOLDER}/{unit}", _MARK.format(unit=unit) + texts[unit])]


def _start(machine: Machine, wanted: Sequence[str], changed: Sequence[str]) -> None:
    """Enable the units and, on this machine, start them; those that have changed are started again.

    Raises:
        RmpaError: One does not start; the text has the last lines of its log.
    """
    if machine.root:
        machine.systemctl("enable", *wanted)
        return
    if changed:
        machine.systemctl("daemon-reload")
    for unit in wanted:
        now = machine.shown(unit)
        if now.get("ActiveState") == "active" and now.get("UnitFileState") == "enabled" and unit not in changed:
            machine.tell(f"{unit} runs")
            continue
        again = now.get("ActiveState") == "active"
        try:
            machine.systemctl("enable", *([] if again else ["--now"]), unit)
            if again:
                machine.systemctl("restart", unit)
        except RmpaError as error:
            text = "\n".join([str(error), *(f"  {line}" for line in machine.log(unit))])
            raise RmpaError(text, code="service-unit") from None


@json_verb()
def service_status(options: Options) -> int:
    """Show the units of rmpa: whether they run and since when, at boot or not, the end of their log; and the peers.

    ---
    Exit codes: 0 the agent's unit runs; 1 it does not, or it is not installed.

    Examples:
      rmpa service status
      rmpa service status --json | jq .units
    """
    machine = Machine("", dry=True)
    machine.check("status")
    states = [_state(machine, name) for name in UNITS.values()]
    # A package has all units, of which web server and gateway may be of no use here.
    units = [states[0], *(state for state in states[1:] if state["enabled"] or state["active"] not in _AWAY)]
    peers, waiting, problem = _peers() if units[0]["active"] == "active" else ([], "", "")

    def text() -> Iterator[Text]:
        for unit in units:
            yield from _unit_lines(unit)
        if peers:
            linked = sum(state == "linked" for _, state in peers)
            yield f"{len(peers)} peer{'' if len(peers) == 1 else 's'}, {linked} linked: `rmpa peer list`"
        elif units[0]["active"] == "active":
            yield f"peers: {problem or waiting or 'none yet'}"

    found = [{"name": name, "state": state} for name, state in peers]
    options.show({"units": units, "peers": found, "problem": problem}, text())
    return 0 if units[0]["active"] == "active" else 1


def _state(machine: Machine, unit: str) -> dict[str, object]:
    shown = machine.shown(unit)
    since = int(shown.get("StateChangeTimestampMonotonic") or 0) / 1e6
    installed = shown.get("LoadState") == "loaded"
    return {
        "unit": unit,
        "installed": installed,
        "active": shown.get("ActiveState", "unknown"),
        "sub": shown.get("SubState", ""),
        "since": time.clock_gettime(time.CLOCK_MONOTONIC) - since if since else None,
        "enabled": shown.get("UnitFileState", "") == "enabled",
        "set_up": is_set_up(shown),
        "result": shown.get("Result", ""),
        "pid": int(shown.get("MainPID") or 0) or None,
        "restarts": int(shown.get("NRestarts") or 0),
        "log": machine.log(unit) if installed else [],
    }


def _unit_lines(unit: dict[str, object]) -> Iterator[str]:
    from rmpa.cli.output import duration

    name, active = unit["unit"], unit["active"]
    if not unit["installed"]:
        yield f"{name} is not installed: sudo rmpa service install"
        return
    since, pid = unit["since"], unit["pid"]
    words = [str(active) if active == unit["sub"] else f"{active} ({unit['sub']})"]
    if isinstance(since, float):
        words.append(f"for {duration(since)}")
    if pid:
        words.append(f"pid {pid}")
    words.append("at boot" if unit["enabled"] else "not at boot")
    if unit["restarts"]:
        words.append(f"started again {unit['restarts']} times")
    if unit["result"] not in ("", "success"):
        words.append(f"failed by {unit['result']}")
    yield f"{name}: {', '.join(words)}"
    if not unit["enabled"]:
        start = f"sudo systemctl enable {name}" if unit["set_up"] else INSTALL
        yield f"    to start it at boot: {start}"
    log = unit["log"]
    if isinstance(log, list):
        yield from (f"    {line}" for line in log)
        if not log:
            yield f"    its log: sudo journalctl -u {str(name).removesuffix('.service')}"


def _peers() -> tuple[list[tuple[str, str]], str, str]:
    """The peers of the unit's agent, what is said of modules that are none, and why nothing is known."""
    from rmpa.observe.control_client import ControlClient, find_agents

    try:
        for agent in find_agents({"RMPA_RUNTIME_DIR": RUNTIME}):
            with ControlClient(agent.path) as client:
                snapshot = client.snapshot(topics=())
            if not snapshot.agent.name.endswith(GATEWAY_SUFFIX):
                others = ", ".join(f"{one.name} is {one.state}" for one in snapshot.strangers[:3])
                waiting = f"{others}: `rmpa peer list`" if others else ""
                return [(peer.name, peer.state) for peer in snapshot.peers], waiting, ""
    except RmpaError as error:
        return [], "", str(error)
    return [], "", f"this user may not ask: use sudo, or join the group {GROUP}"


@json_verb(
    flag("--purge", "Remove settings and state too, and the user rmpa: the module's name and keys are then lost."),
    flag("--yes", "Do not ask."),
    flag("--dry-run", "Change nothing; say what would be done."),
    option("--root", "DIR", "The folder of another system, such as an image.", default=""),
)
def service_uninstall(purge: bool, yes: bool, dry_run: bool, root: str, options: Options) -> int:
    """Stop rmpa, disable it at boot, and remove what `rmpa service install` has made.

    /etc/rmpa and /var/lib/rmpa stay, unless --purge says otherwise.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option.

    Examples:
      sudo rmpa service uninstall
      sudo rmpa service uninstall --purge --yes   in a script
      rmpa service uninstall --dry-run
    """
    root = root.rstrip("/")
    machine = Machine(root, dry=dry_run, tell=(lambda _: None) if options.as_json else click.echo)
    machine.check("uninstall")
    if purge and machine.has_packaged():
        raise refused("uninstall", "the package has settings and state", "sudo apt purge rmpa")
    if purge and not (yes or dry_run) and not confirm(f"Remove {CONFIG} and all of {STATE}, keys too?"):
        raise ConfigError("rmpa service uninstall", "nothing was removed", code="not-confirmed")
    units = ((unit, machine.unit(unit)) for unit in UNITS.values())
    # One that was written by hand stays.
    parts = [unit for unit, path in units if (_is_made(path) if path.is_file() else machine.has_packaged(unit))]
    if parts:
        machine.systemctl("disable", *([] if root else ["--now"]), *parts)
    removed = _remove_made(machine, (*UNITS.values(), *DROP_INS.values()))
    for unit in removed:
        old = machine.unit(f"{unit}{_BY_HAND}")
        if old.is_file() and machine.change(f"rename {UNIT_FOLDER}/{old.name} to {unit}"):
            old.rename(old.with_name(unit))
    if removed and not root:
        machine.systemctl("daemon-reload")
    if purge:
        _purge(machine)
    elif not machine.has_packaged():
        stays = [each for each in (CONFIG, STATE) if machine.path(each).exists()]
        stays += [f"the user {USER}"] if machine.ids(USER) is not None else []
        if stays:
            machine.tell(f"{', '.join(stays)} stay; they go by: rmpa service uninstall --purge")
    if not machine.changes:
        machine.tell("nothing is installed")
    options.show({"units": parts, "changes": machine.changes, "dry_run": dry_run})
    return 0


def _is_made(path: Path) -> bool:
    """Whether ``install`` has made a file."""
    return path.read_text("utf-8", "replace").startswith(_MARK.partition("{")[0])


def _remove_made(machine: Machine, places: Iterable[str]) -> list[str]:
    """Remove those of some files in the folder of units that ``install`` has made; return which."""
    found = []
    for place in places:
        path = machine.unit(place)
        if path.is_file() and _is_made(path):
            found.append(place)
            if machine.change(f"remove {UNIT_FOLDER}/{place}"):
                path.unlink()
                if path.parent.name.endswith(".d") and not any(path.parent.iterdir()):
                    path.parent.rmdir()
    return found


def _purge(machine: Machine) -> None:
    config, state = machine.path(CONFIG), machine.path(STATE)
    if config.is_file() and machine.change(f"remove {CONFIG}"):
        config.unlink()
        if not any(config.parent.iterdir()):
            config.parent.rmdir()
    for place in (state, machine.path(RUNTIME)):
        if place.is_dir() and machine.change(f"remove {str(place).removeprefix(machine.root)}"):
            machine.remove_folder(place)
    for kind, name, _ in reversed(_ACCOUNTS):
        if machine.number(kind, name) is not None:
            machine.run(f"remove the {kind} {name}", f"{kind}del", name)
