"""Each handler of messages from outside declares its permissions; docs/reference/security.md lists them."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import rmpa
from rmpa.bridge.policy import Needs

SOURCE: Final = Path(rmpa.__file__).parent
PAGE: Final = Path(__file__).parents[2] / "docs" / "reference" / "security.md"
BEGIN: Final = "<!-- The table is compared with the code by tests/bridge/test_permission_table.py. -->\n"
KINDS: Final = {"on_request": "request", "on_notification": "notification", "queryable": "query"}
"""The methods at which handlers are registered: of ``PeerRpc``, and of Zenoh's session."""
REGISTRARS: Final = frozenset({"rpc", "_rpc", "asks", "session", "_session"})
"""The names under which both are called in ``src``."""


class Registrations(ast.NodeVisitor):
    """The registrations in one module, with the names that are assigned around each."""

    def __init__(self, scope: dict[str, Any], where: Path) -> None:
        self.scope, self.where = scope, where
        self.found: list[tuple[str, str, Needs]] = []

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer, self.scope = self.scope, dict(self.scope)
        self.generic_visit(node)
        self.scope = outer

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "Needs":
            self.scope[ast.unparse(node.targets[0])] = self._value(node.value)
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        """Handlers that are registered from a table have a turn each."""
        table, _, method = ast.unparse(node.iter).partition(".")
        if method != "items()" or not isinstance(self.scope.get(table), dict):
            self.generic_visit(node)
            return
        outer = self.scope
        for key, value in self._value(node.iter):
            names = [ast.unparse(name) for name in getattr(node.target, "elts", [])]
            self.scope = outer | dict(zip(names, (key, value), strict=True))
            self.generic_visit(node)
        self.scope = outer

    def visit_Call(self, node: ast.Call) -> None:
        *_, owner, kind = ("", *ast.unparse(node.func).split("."))
        if kind in KINDS and owner in REGISTRARS:
            assert len(node.args) == 3, f"{self.where}:{node.lineno}: a handler is registered without its Needs"
            needs = self._value(node.args[2])
            name = needs.key if kind == "queryable" else str(self._value(node.args[0]))
            assert name, f"{self.where}:{node.lineno}: the Needs of a query say no key"
            self.found.append((KINDS[kind], name, needs))
        self.generic_visit(node)

    def _value(self, node: ast.expr) -> Any:
        return eval(ast.unparse(node), self.scope)


def registrations() -> Iterator[tuple[str, str, Needs]]:
    for path in sorted(SOURCE.rglob("*.py")):
        text = path.read_text()
        if any(f".{method}(" in text for method in KINDS):
            name = ".".join(("rmpa", *path.relative_to(SOURCE).with_suffix("").parts))
            visitor = Registrations(dict(vars(importlib.import_module(name))), path)
            visitor.visit(ast.parse(text))
            yield from visitor.found


def table() -> str:
    order = list(KINDS.values())
    lines = ["| handler | permission | for which names, or why none |", "|---|---|---|"]
    for kind, name, needs in sorted(set(registrations()), key=lambda row: (order.index(row[0]), row[1])):
        access = ", ".join(f"`{access}`" for access in needs.access) or "none"
        lines.append(f"| {kind} {name if ' ' in name else f'`{name}`'} | {access} | {needs.of} |")
    return "\n".join(lines) + "\n"


def test_the_documentation_lists_every_handler_with_the_permission_that_it_asks() -> None:
    _, begin, rest = PAGE.read_text().partition(BEGIN)
    assert begin, f"docs/reference/security.md has lost its line {BEGIN}"
    assert rest.partition("\n\n")[0] + "\n" == table(), f"write into docs/reference/security.md:\n{table()}"


def test_every_kind_of_handler_is_found() -> None:
    found = {name for _, name, _ in registrations()}
    assert {"param.get", "node.ping", "trust.renew", "direct.topic_release"} <= found
    assert "rmpa/1/<site>/-gateway/why" in found
