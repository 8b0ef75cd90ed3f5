"""Which module a command is about: one decision for all commands.

::

    option > RMPA_AGENT > RMPA_NAME > rmpa.toml > the agent that runs > the name of the first start > the default

A name that is *said* (the first four) holds, whatever runs. Agents that run count for commands beside an agent alone:
``rmpa up`` starts one.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rmpa.core.errors import RmpaError

GATEWAY_SUFFIX = "_gateway"
"""What a gateway's name has behind that of its module."""


class NameSource(Enum):
    """Why a name was chosen."""

    OPTION = "the option"
    AGENT_VARIABLE = "RMPA_AGENT"
    VARIABLE = "RMPA_NAME"
    FILE = "name in rmpa.toml"
    RUNNING = "the agent that runs here"
    KEPT = "the name of the first start"
    DEFAULT = "this host's name"

    @property
    def said(self) -> bool:
        """Whether the user has said it for this command; it then holds, whatever runs."""
        return self in _SAID


_SAID = frozenset((NameSource.OPTION, NameSource.AGENT_VARIABLE, NameSource.VARIABLE, NameSource.FILE))


@dataclass(frozen=True, slots=True)
class NameFacts:
    """What the choice depends on. Empty: there is none.

    Attributes:
        option: ``--name`` or ``--agent``.
        agent_variable: RMPA_AGENT; commands that start an agent leave it out.
        variable: RMPA_NAME.
        file: ``name`` in ``rmpa.toml``.
        running: The agents that run on this machine; commands that start one leave them out.
        gateways: Those among them that are gateways.
        of_master: The one among them whose core ROS_MASTER_URI names.
        kept: The name that is kept in the state directory.
        default: The name without any of these.
    """

    option: str = ""
    agent_variable: str = ""
    variable: str = ""
    file: str = ""
    running: tuple[str, ...] = ()
    gateways: tuple[str, ...] = ()
    of_master: str = ""
    kept: str = ""
    default: str = ""


@dataclass(frozen=True, slots=True)
class ModuleName:
    """A name, and why it was chosen."""

    name: str
    source: NameSource

    def __str__(self) -> str:
        """``base (name in rmpa.toml)``."""
        return f"{self.name} ({self.source.value})"


def choose_name(facts: NameFacts) -> ModuleName:
    """The module that a command is about.

    Raises:
        RmpaError: Several agents run, and nothing says which is meant.
    """
    for name, source in (
        (facts.option, NameSource.OPTION),
        (facts.agent_variable, NameSource.AGENT_VARIABLE),
        (facts.variable, NameSource.VARIABLE),
        (facts.file, NameSource.FILE),
    ):
        if name:
            return ModuleName(name, source)
    if facts.running:
        return ModuleName(running_agent(facts), NameSource.RUNNING)
    if facts.kept:
        return ModuleName(facts.kept, NameSource.KEPT)
    return ModuleName(facts.default, NameSource.DEFAULT)


def running_agent(facts: NameFacts) -> str:
    """Which of the agents that run is meant: the only one, that of ROS_MASTER_URI, that of a name, the only module.

    Args:
        facts: With at least one agent. The names of variable, file and first start choose only among them.

    Raises:
        RmpaError: It could be several.
    """
    if len(facts.running) == 1:
        return facts.running[0]
    for name in (facts.of_master, facts.variable, facts.file, facts.kept):
        if name in facts.running:
            return name
    modules = [name for name in facts.running if name not in facts.gateways]
    if len(modules) == 1:
        return modules[0]
    listed = ", ".join(facts.running)
    raise RmpaError(f"several agents run on this machine: {listed}; name one with --agent NAME or RMPA_AGENT")
