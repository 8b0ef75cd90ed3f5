"""What a resource has declared, and what follows from it: labels of topics, attributes, expressions."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_legal_name
from rmpa.resource.declare import AdaptationSettings
from rmpa.resource.expression import Expression, parse_expression
from rmpa.resource.quality import MEASURED, Attribute
from rmpa.runtime.programs import StartRule

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from rmpa.resource.declare import (
        AlarmRule,
        Binding,
        Context,
        DeclaredAttribute,
        Demand,
        Hook,
        Input,
        ManagedNode,
        Output,
        Parameter,
        Profile,
        Task,
    )

# Functions in expressions that the running resource answers, with the numbers of their arguments.
SOURCES: Final[Mapping[str, tuple[int, ...]]] = {
    # Processor time of a node's process as a share of one core; memory that it holds, bytes. Without a name: of the
    # resource's only node.
    "cpu": (0, 1),
    "memory": (0, 1),
    # Of the machine: the hottest thermal zone, or the zone of this type, in °C.
    "temperature": (0, 1),
    # The number in a value of /diagnostics: name of the status, key; or the level of the status, 0 to 3.
    "diagnostics": (1, 2),
    # Whether a node is registered at the core and answers.
    "running": (1,),
}


class Role(StrEnum):
    """The function of a module in the robot (paper, section 3)."""

    SENSING = "sensing"
    ACTING = "acting"
    CONTROLLING = "controlling"


class ResourceDeclaration:
    """The tables of a declaration, in the order in which its parts were declared.

    Args:
        name: A ROS base name; the resource's node is ``/<name>``.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether the resource has a real device; else it is simulated.
        description: A text for people.

    Raises:
        ConfigError: The name is illegal or the role is unknown.
    """

    def __init__(self, name: str, *, role: str, physical: bool = True, description: str = "") -> None:
        if not name or not is_legal_name(name) or "/" in name or name.startswith("~"):
            raise ConfigError("resource", f"{name!r} is not a ROS base name", "letters, digits and _, a letter first")
        if role not in set(Role):
            remedy = suggestion(role, list(Role), f"it is one of {', '.join(Role)}")
            raise ConfigError(f"resource {name}", f"there is no role {role!r}", remedy)
        self.name = name
        self.role = Role(role)
        self.physical = physical
        self.description = description
        self.outputs: dict[str, Output] = {}
        self.inputs: dict[str, Input] = {}
        self.parameters: dict[str, Parameter] = {}
        self.declared_attributes: dict[str, DeclaredAttribute] = {}
        self.profiles: dict[str, Profile] = {}
        self.contexts: dict[str, Context] = {}
        self.tasks: dict[str, Task] = {}
        self.demands: dict[str, Demand] = {}
        self.hooks: dict[str, Hook] = {}
        # Nodes that exist without the resource, by their declared names.
        self.nodes: dict[str, ManagedNode] = {}
        self.alarms: dict[str, AlarmRule] = {}
        self.start = StartRule()
        # Base name of the file that declares it; empty: unknown.
        self.file = ""
        # The folder of the file that declares it, in which its nodes are started; ``None``: that of the process.
        self.folder: Path | None = None
        # Parameters of the control loop.
        self.settings = AdaptationSettings()

    @property
    def bound(self) -> dict[str, Binding]:
        """Where other nodes have the values of parameters, by parameter."""
        return {name: one.binding for name, one in self.parameters.items() if one.binding is not None}

    @property
    def labels(self) -> dict[str, str]:
        """The prefix of the measured attributes of each output and input, by name, outputs first.

        The prefix is the last part of the name; if that is taken, as many last parts as make it unique, joined by
        dots; if all are taken, the whole name after ``in.`` or ``out.``.
        """
        topics = self.outputs | self.inputs
        found = {name: topic.label for name, topic in topics.items() if topic.label}
        for name in (name for name in topics if name not in found):
            parts = name.strip("/").split("/")
            several = [".".join(parts[-count:]) for count in range(1, len(parts) + 1)]
            several.append(f"{'in' if name in self.inputs else 'out'}.{several[-1]}")
            found[name] = next((label for label in several if label not in found.values()), several[-1])
        return {name: found[name] for name in topics}

    @property
    def attributes(self) -> dict[str, Attribute]:
        """All attributes that clients may request: the declared ones, and those measured of each output and input.

        ``rate`` is that of the first output; ``scan.rate`` names the output or input by its label (``labels``).
        """
        found: dict[str, Attribute] = {}
        for position, label in enumerate(self.labels.values()):
            for key, attribute in MEASURED.items():
                if position == 0 and self.outputs:
                    found[key] = attribute
                found[f"{label}.{key}"] = attribute
        return found | {name: declared.attribute for name, declared in self.declared_attributes.items()}

    def expression(self, text: str, where: str) -> Expression:
        """Parse an expression over the resource's topics, parameters, attributes and ``SOURCES``.

        Raises:
            ConfigError: It is invalid, or names a node that is not declared; ``where`` begins the error's text.
        """
        parsed = parse_expression(text, self.parameters, where, attributes=self.attributes, sources=SOURCES)
        for source in parsed.sources.values():
            if source.function not in ("cpu", "memory", "running"):
                continue
            if not source.arguments and len(self.nodes) != 1:
                raise ConfigError(where, f"{source.function}() of which node?", f"there are {len(self.nodes)}")
            if source.arguments and (node := source.arguments[0]) not in self.nodes:
                remedy = suggestion(node, self.nodes, f"declared are {', '.join(self.nodes) or 'none'}")
                raise ConfigError(where, f"there is no node {node}", remedy)
        return parsed

    def expressions(self) -> Iterator[Expression]:
        """All expressions of the declaration: rules of contexts, alarms and profiles, and values of attributes."""
        rules = (
            *((f"context {one.name}", one.when) for one in self.contexts.values()),
            *((f"alarm {one.name}", one.when) for one in self.alarms.values()),
            *((f"profile {one.name}", one.rule) for one in self.profiles.values()),
        )
        yield from (self.expression(text, f"{where} of {self.name}") for where, text in rules if text)
        yield from (one.value for one in self.declared_attributes.values() if one.value is not None)
