"""The module of this machine that a command beside its agent is about, and whether such a command can start."""

from __future__ import annotations

import functools
import importlib.util
import os
import socket
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from rmpa.cli.options import Options, config_option, json_verb, option
from rmpa.cli.output import warn
from rmpa.cli.units import STATE
from rmpa.config import module_name
from rmpa.config.read import Loaded, load_settings
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, RmpaError, StartError, UnreachableError, missing_extra
from rmpa.core.identity import peer_name_problem
from rmpa.observe.control_client import ControlClient, find_agents, running_agents
from rmpa.runtime.plugins import NEIGHBOURS, find_plugins
from rmpa.runtime.systemd import restart_text
from rmpa.trust.permissions import TrustStatus
from rmpa.trust.store import TrustStore

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.config.module_name import ModuleName
    from rmpa.trust.membership import Membership, MeshAuthority

_T = TypeVar("_T")
# The codes of files that this user cannot use.
_CLOSED: Final = ("keys-unusable", "directory-unusable")


@dataclass(frozen=True, slots=True)
class Module:
    """The module of this machine that a command beside an agent is about.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        state: Its state directory; ``None``: there is none.
        socket: The control socket of its agent; ``None``: none runs.
        trust: What its agent says of trust; ``None``: none runs.
        config_file: The settings of its agent; empty: it has none, or none runs.
        pid: The process of its agent; 0: none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    state: Path | None
    socket: Path | None = None
    trust: TrustStatus | None = None
    config_file: str = ""
    pid: int = 0

    @property
    def name(self) -> str:
        """Its name."""
        return self.chosen.name

    @property
    def agent(self) -> str:
        """How its agent runs: ``secured``, ``plain`` or ``off``."""
        return "off" if self.trust is None else self.trust.agent

    def restart(self, start: str = "rmpa up") -> str:
        """What is said of its agent, which does not have its keys yet."""
        return f"the agent {self.name} runs without its keys; restart it: {restart_text(self.pid, start)}"

    @property
    def place(self) -> Path:
        """Its state directory.

        Raises:
            StartError: There is none.
        """
        if self.state is None:
            what, problem = "the state directory", "is not known: there is no home"
            raise StartError(what, problem, "set RMPA_STATE_DIR", code="no-state-directory")
        return self.state

    def refused(self, problem: str, remedy: str, code: str) -> StartError:
        """The error of a command that the module's part in a mesh does not allow."""
        return StartError(f"the module {self.name}", problem, remedy, code=code)

    @property
    def store(self) -> TrustStore:
        """Its keys and certificates.

        Raises:
            StartError: There is no state directory.
        """
        return TrustStore(self.place, self.name)

    def call(self, what: str, reply: type[_T], **args: object) -> _T:
        """Let the agent do something.

        Raises:
            UnreachableError: No agent runs, or it does not answer.
            PeerRefused: It refuses, and says why.
        """
        if self.socket is None:
            raise UnreachableError(f"agent {self.name!r}", "this machine", "start it: rmpa up")
        with ControlClient(self.socket) as client:
            return client.call("trust", reply, what=what, **args)

    def membership(self) -> Membership:
        """What the files say, without the agent.

        Raises:
            StartError: Trust is off here, or the files are broken.
        """
        check_library()
        if not self.store.exists:
            remedy = "make a mesh: rmpa trust init; or join one: rmpa trust join TOKEN"
            raise self.refused("has joined no secured mesh", remedy, "not-a-member")
        from rmpa.runtime.loop import SystemClock
        from rmpa.trust.membership import Membership

        return Membership.load(self.store, SystemClock())

    def authority(self) -> MeshAuthority:
        """What the files say, without the agent, of the authority.

        Raises:
            StartError: Trust is off here, this module is not the authority, or a file is broken.
        """
        membership = self.membership()
        from rmpa.trust.membership import MeshAuthority

        if not self.store.is_authority:
            place = self.store.load_authority()
            where = f"do it at {place.name}" if place is not None and place.name else "do it at the authority"
            raise self.refused("is not the authority of its mesh", where, "not-authority")
        return MeshAuthority(membership)

    def refuse_member(self, leaving: str) -> None:
        """Check that the module has no keys yet.

        Args:
            leaving: What is said of ``rmpa trust leave``.

        Raises:
            StartError: It has.
        """
        check_library()
        if self.store.exists:
            remedy = f"rmpa trust status shows it; rmpa trust leave {leaving}"
            raise self.refused("is a member of a secured mesh already", remedy, "already-a-member")


def find_module(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> Module:
    """The module that a command beside an agent is about, as its agent knows it if that runs.

    Args:
        name: As the command's option names it.
        options: As for ``load_settings``.
        environ: The environment's variables.
        option: The command's option, for errors.

    Raises:
        ConfigError: The name cannot be one, or a setting cannot be used.
        RmpaError: Several agents run, and none is meant; or the agent does not answer.
    """
    environ = module_name.of_unit(environ)
    for source, text in ((option, name), ("RMPA_AGENT", environ.get("RMPA_AGENT"))):
        if text and (problem := peer_name_problem(text)):
            raise ConfigError(source, problem)
    loaded = load_settings(options, environ, host_name=socket.gethostname())
    agents = find_agents(environ)
    names = {**loaded.names, module_name.NameSource.AGENT_VARIABLE: environ.get("RMPA_AGENT", "")}
    if name:
        names[module_name.NameSource.OPTION] = name
    chosen = module_name.choose_name(names, *running_agents(agents, environ))
    loaded = replace(loaded, settings=replace(loaded.settings, name=chosen.name))
    path = next((agent.path for agent in agents if agent.name == chosen.name), None)
    if path is None:
        return Module(chosen, loaded, module_name.state_dir(environ, loaded.settings.state_dir))
    with ControlClient(path) as client:
        trust, agent = client.call("trust", TrustStatus, what="status"), client.agent()
    # The agent may have been started with another state directory than this shell has.
    state = Path(trust.folder).parent.parent if trust.folder else None
    return Module(chosen, loaded, state, path, trust, agent.config_file, agent.pid)


def agent_settings(module: Module) -> Loaded:
    """The settings whose rules the module's agent applies: of its own file, also where this shell finds another."""
    file = module.loaded.settings.config_file
    if module.socket is None or module.config_file == (str(file.absolute()) if file is not None else ""):
        return module.loaded
    if not module.config_file:
        return Loaded(Settings())
    return load_settings({"config": module.config_file}, os.environ, host_name=socket.gethostname())


def check_library() -> None:
    """Raise ``StartError`` if the library for certificates is missing."""
    try:
        import cryptography  # noqa: F401
    except ModuleNotFoundError:
        problem = "the library cryptography is not installed"
        raise StartError("rmpa trust", problem, missing_extra("trust"), code="extra-missing") from None


def check_gateway(settings: Settings) -> None:
    """Check that a gateway with these settings has its libraries, something to join, and a way to it.

    Raises:
        ConfigError: It has not.
    """
    it = settings.gateway
    by_zenoh = it.site or it.router or not it.via_rclpy
    zenoh = {"zenoh": "eclipse-zenoh"} if by_zenoh else {}
    _check_libraries("rmpa gateway", "zenoh", {**zenoh, "xxhash": "xxhash"})
    if not (it.site or it.ros2.enabled or it.router or find_plugins(NEIGHBOURS)):
        raise ConfigError("rmpa gateway", "there is nothing to join", "say --site NAME for other sites, or --ros2")
    if it.router and not it.listen:
        raise ConfigError("gateway.router", "a router that listens nowhere", "add --listen tls/0.0.0.0:7447")
    if not (it.connect or it.listen) and by_zenoh:
        example = "tcp/localhost:7447 for rmw_zenohd here" if it.ros2.enabled else "tls/fleet.example:7447"
        problem = "there is no connection to other sites"
        raise ConfigError("rmpa gateway", problem, f"add --connect, such as {example}")


def check_web() -> None:
    """Check that ``rmpa web`` has its libraries.

    Raises:
        ConfigError: It has not.
    """
    _check_libraries("rmpa web", "web", {name: name for name in ("aiohttp", "cbor2")})


def check_record(command: str) -> None:
    """Check that a command about recordings has its libraries.

    Raises:
        ConfigError: It has not.
    """
    _check_libraries(command, "record", {"mcap": "mcap", "jinja2": "Jinja2"})


def _check_libraries(program: str, extra: str, libraries: Mapping[str, str]) -> None:
    """Check that the libraries of an extra are there.

    Args:
        program: The command.
        extra: The extra of rmpa that has them.
        libraries: The name in Python, and that of the package.

    Raises:
        ConfigError: One is missing.
    """
    missing = [package for name, package in libraries.items() if not _is_there(name)]
    if missing:
        problem = f"{' and '.join(missing)} not installed"
        raise ConfigError(program, problem, f"run {missing_extra(extra)}", code="extra-missing")


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # it was taken out of sys.modules
        return False


def module_verb(*parameters: Any) -> Callable[[Callable[..., None]], click.Command]:
    """A ``json_verb`` with ``--name`` and ``--config``, whose function gets the module that they mean."""
    name_option = option(
        "--name",
        "NAME",
        "This module. [default: RMPA_AGENT, RMPA_NAME, rmpa.toml, the agent that runs; else as rmpa up has it]",
    )

    def decorate(function: Callable[..., None]) -> click.Command:
        @functools.wraps(function)
        def command(name: str | None, config: str | None, options: Options, **given: Any) -> None:
            module = find_module(name, {"config": config}, os.environ)
            try:
                function(module, options, **given)
            except StartError as error:
                if not (os.geteuid() and module.state == Path(STATE) and error.code in _CLOSED):
                    raise
                words = click.get_current_context().command_path
                problem, remedy = f"the keys of {module.name} are the service's", f"sudo {words} …"
                raise StartError(words, problem, remedy, code="root-needed") from None

        return json_verb(*parameters, name_option, config_option)(command)

    return decorate


def keep_member_name(module: Module) -> str:
    """Keep the name of a module that has keys now as that of this machine; return the command that starts it.

    The name of another module that has keys itself stays. A gateway's is none of a module.
    """
    if unnoted := module_name.note_state_dir(module.place):
        missed = f"a start without RMPA_STATE_DIR={module.place} will miss these keys: {unnoted}"
        warn(f"{missed}; write require = true into [trust] of rmpa.toml", "directory-unusable")
    if module.name.endswith(module_name.GATEWAY_SUFFIX):
        return f"rmpa gateway --name {module.name}"
    usual = ""
    try:
        kept = module_name.kept_name(module.place)
        if not kept or kept == module.name or not TrustStore(module.place, kept).exists:
            module_name.keep_name(module.place, module.name, instead=True)
        config = {"config": module.loaded.settings.config_file}
        usual = load_settings(config, os.environ, host_name=socket.gethostname()).settings.name
    except RmpaError as error:
        warn(f"the name {module.name} is not kept: {error}", "directory-unusable")
    return "rmpa up" if usual == module.name else f"rmpa up --name {module.name}"
