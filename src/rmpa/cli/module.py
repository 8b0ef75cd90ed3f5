"""The module that a command beside an agent is about: its name, settings and files, and its agent if that runs."""

from __future__ import annotations

import logging
import os
import socket
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.config.module_name import GATEWAY_SUFFIX, choose_name, keep_name, state_dir
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.identity import peer_name_problem
from rmpa.observe.control_client import ControlClient, find_agents, with_running
from rmpa.trust.joining import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.module_name import ModuleName, NameFacts
    from rmpa.config.read import Loaded
    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundName:
    """The name of a module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        socket: The control socket of its agent; ``None``: none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    socket: Path | None


@dataclass(frozen=True, slots=True)
class Module:
    """One module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        state: Its state directory; ``None``: there is none.
        socket: The control socket of its agent; ``None``: none runs.
        trust: What its agent says of trust; ``None``: none runs.
        config_file: The settings of its agent; empty: it has none, or none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    state: Path | None
    socket: Path | None = None
    trust: TrustStatus | None = None
    config_file: str = ""

    @property
    def name(self) -> str:
        """Its name."""
        return self.chosen.name

    @property
    def secured(self) -> bool:
        """Whether its agent runs as a member of a secured mesh."""
        return self.trust is not None and self.trust.agent == "secured"


def find_name(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> FoundName:
    """The name of the module that a command beside an agent is about.

    Args:
        name: As the command's option names it.
        options: As for ``load_settings``.
        environ: The environment's variables.
        option: The command's option, for errors.

    Raises:
        ConfigError: The name cannot be one, or a setting cannot be used.
        RmpaError: Several agents run, and none is meant.
    """
    for source, text in ((option, name), ("RMPA_AGENT", environ.get("RMPA_AGENT"))):
        if text and (problem := peer_name_problem(text)):
            raise ConfigError(source, problem)
    loaded = load_settings(options, environ, host_name=socket.gethostname())
    agents = find_agents(environ)
    facts = replace(loaded.name_facts, agent_variable=environ.get("RMPA_AGENT", ""))
    if name:
        facts = replace(facts, option=name)
    chosen = choose_name(with_running(facts, agents, environ))
    loaded = replace(loaded, settings=replace(loaded.settings, name=chosen.name))
    return FoundName(chosen, loaded, next((agent.path for agent in agents if agent.name == chosen.name), None))


def find_module(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> Module:
    """The module that a command beside an agent is about, as its agent knows it if that runs.

    Args and errors as for ``find_name``; also ``RmpaError``: the agent does not answer.
    """
    found = find_name(name, options, environ, option)
    chosen, loaded, path = found.chosen, found.loaded, found.socket
    if path is None:
        return Module(chosen, loaded, state_dir(environ, loaded.settings.state_dir))
    with ControlClient(path) as client:
        trust, config_file = client.call("trust", TrustStatus, what="status"), client.agent().config_file
    # The agent may have been started with another state directory than this shell has.
    state = Path(trust.folder).parent.parent if trust.folder else None
    return Module(chosen, loaded, state, path, trust, config_file)


def keep_first_name(settings: Settings, facts: NameFacts) -> None:
    """Keep a name that was given by ``--name`` at the first start of a module, for the starts and commands to come.

    One that starts beside another agent is a second module of this machine, and a gateway is none.
    """
    directory = state_dir(os.environ, settings.state_dir)
    name = facts.option
    if not name or directory is None or facts.kept or name.endswith(GATEWAY_SUFFIX):
        return
    try:
        if any(agent.name != name for agent in find_agents(os.environ)):
            return
        keep_name(directory, name)
    except RmpaError as error:
        _log.warning("! the name %s is not kept: %s", name, error)
