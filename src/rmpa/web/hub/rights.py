"""What clients may do: kinds of acts by ``[web]``, and names by the rules of ``[[permission]]``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused
from rmpa.ros.master.parameters import canonical, leaves

if TYPE_CHECKING:
    from rmpa.trust.documents import Permissions
    from rmpa.web.hub.requests import ParamValue

_WHO: Final = "the web server"
_NODE: Final = "web"
"""The name of ``rmpa web`` for the rules."""


@dataclass(frozen=True, slots=True)
class Rights:
    """What clients may do beyond reading topics and the graph; nothing unless it is said.

    Attributes:
        view: Read parameters, and files of ROS packages.
        control: Publish, call and offer services, set parameters, choose a Smart Resource's profile and context.
        drive: Command a robot by the monitor's joystick.
        command_age: Seconds that what a client publishes, calls and sets may be old; 0: any age.
    """

    view: bool = False
    control: bool = False
    drive: bool = False
    command_age: float = 0.0


@dataclass(frozen=True, slots=True)
class NodeRules:
    """What the node of ``rmpa web`` may do, by names: for ``[[permission]]`` it is the module ``web``.

    Args:
        permissions: Judges; ``None``: it may do everything.
    """

    permissions: Permissions | None = None

    def check(self, access: Access, name: str) -> None:
        """Check one name.

        Raises:
            PeerRefused: It may not; the text has the rule.
        """
        if self.permissions is not None:
            decision = self.permissions.judge(access, _NODE, _resolved(name))
            if not decision.allowed:
                raise PeerRefused(_WHO, f"{_NODE} may not {access} {name}", decision.rule)

    def check_param_change(self, name: str, value_of: Callable[[str], ParamValue], after: ParamValue = None) -> None:
        """Check each parameter that a change of a name replaces, makes or removes; raises as ``check``.

        Args:
            name: A parameter, or a namespace, which is changed as a whole.
            value_of: Returns the present value of a name; ``None`` if there is none.
            after: Its next value; ``None``: it is deleted.
        """
        if self.permissions is None:
            return
        if (key := _bad_key(after)) is not None:
            # A core tells /motors/limit of the change where a key below /speed is that name.
            text = f"{_NODE} may not set {name}: the key {key[:80]!r} is not one part of a name"
            raise PeerRefused(_WHO, text, "write a namespace as a value of values")
        name = _resolved(name)
        values = value_of(name), after
        changed = {leaf for value in values for leaf, each in leaves(name, value) if each is not None}
        # A parameter that stands where a namespace is needed is replaced by one.
        above = [name[:at] for at in range(1, len(name)) if name[at] == "/"]
        changed |= {each for each in above if not isinstance(value_of(each), Mapping | None)}
        for each in sorted(changed) or [name]:
            self.check(Access.PARAM, each)

    def visible(self, values: Mapping[str, ParamValue]) -> Mapping[str, ParamValue]:
        """Those of some parameters that clients may read.

        Args:
            values: Values by global names; a namespace is a mapping.
        """
        if self.permissions is None:
            return values
        shown = {name: self._pruned(name, value) for name, value in values.items()}
        return {name: value for name, value in shown.items() if value is not _HIDDEN}

    def visible_tree(self, tree: Mapping[str, ParamValue]) -> Mapping[str, ParamValue]:
        """The same of a tree of parameters, whose keys are names below the root."""
        if self.permissions is None:
            return tree
        return {name[1:]: value for name, value in self.visible({f"/{key}": tree[key] for key in tree}).items()}

    def _pruned(self, name: str, value: ParamValue) -> ParamValue:
        """A parameter without what is denied; ``_HIDDEN``: nothing is left."""
        if not isinstance(value, Mapping):
            try:
                self.check(Access.PARAM, name)
            except PeerRefused:
                return _HIDDEN
            return value
        pruned = {key: self._pruned(f"{name}/{key}", each) for key, each in value.items()}
        kept = {key: each for key, each in pruned.items() if each is not _HIDDEN}
        return kept if kept or not value else _HIDDEN


_HIDDEN: Final[ParamValue] = object()  # type: ignore[assignment] # it is compared by identity, and never shown


def _resolved(name: str) -> str:
    """A name as the core resolves it: ``//a/`` is ``/a``, and so is ``a``."""
    return canonical(f"/{name}")


def _bad_key(value: ParamValue) -> str | None:
    """A key in a namespace, at any depth, that a core takes for another name than that of a parameter in it."""
    if not isinstance(value, Mapping):
        return None
    for key, each in value.items():
        if not key or "/" in key:
            return key
        if (inner := _bad_key(each)) is not None:
            return inner
    return None


EVERYTHING = NodeRules()
READ_ONLY = Rights()
FULL = Rights(view=True, control=True)
"""Everything but ``drive``, which has a setting of its own."""
CONTROL_REMEDY = "start rmpa web with --control, and give its token"
"""For clients that want to change something."""
READ_REMEDY = "send the token of rmpa web; where it has none, start it with --token-file FILE or --control"
"""For clients that want to read what only clients with the token may."""
