"""What holds for all of the tree: class names, imports, codes."""

from __future__ import annotations

import ast
import logging
import re
from collections import defaultdict
from graphlib import TopologicalSorter
from importlib import import_module
from io import StringIO
from pathlib import Path
from pkgutil import walk_packages
from typing import TYPE_CHECKING, Final

import pytest

import rmpa
from rmpa.core import codes
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.log import RefusalLog, configure_logging
from rmpa.core.statistics import Counters

if TYPE_CHECKING:
    from collections.abc import Iterator

SRC = Path(rmpa.__path__[0])
CODES = codes.texts()
TREES = {path.relative_to(SRC): ast.parse(path.read_text()) for path in sorted(SRC.rglob("*.py"))}
# All calls, and the constant texts that variables are set to, by module and name.
CALLS: list[tuple[Path, ast.Call]] = []
VARIABLES: dict[tuple[Path, str], list[str]] = {}
for file, tree in TREES.items():
    for each in ast.walk(tree):
        if isinstance(each, ast.Call):
            CALLS.append((file, each))
        if isinstance(each, ast.Assign | ast.AnnAssign) and isinstance(each.value, ast.Constant):
            target = each.targets[0] if isinstance(each, ast.Assign) else each.target
            if isinstance(target, ast.Name):
                VARIABLES.setdefault((file, target.id), []).append(str(each.value.value))
# Methods that take the name of a counter first, or second behind the time.
REFUSALS = {"refuse", "warn", "_on_warning", "_refuse"}


def calls(*names: str) -> Iterator[tuple[Path, ast.Call, str]]:
    """All calls of methods or functions of these names, each with what it is called on."""
    for path, node in CALLS:
        of = node.func
        name = of.attr if isinstance(of, ast.Attribute) else of.id if isinstance(of, ast.Name) else ""
        if name in names:
            yield path, node, ast.unparse(of.value) if isinstance(of, ast.Attribute) else ""


def texts(path: Path, node: ast.expr) -> list[str]:
    """The constant texts that an expression may be: itself, or what its variable is set to in that module."""
    if isinstance(node, ast.Constant):
        return [str(node.value)]
    if isinstance(node, ast.JoinedStr):
        return ["".join(str(part.value) if isinstance(part, ast.Constant) else "*" for part in node.values)]
    return VARIABLES.get((path, node.id), []) if isinstance(node, ast.Name) else []


def test_each_warning_of_the_log_ends_with_a_code() -> None:
    bare = []
    for path, call, of in calls("warning", "error", "log"):
        if "log" not in of or any(keyword.arg == "exc_info" for keyword in call.keywords):
            continue  # a traceback has the code internal-error, by the formatter
        by_level = isinstance(call.func, ast.Attribute) and call.func.attr == "log"
        if by_level and "DEBUG if" in ast.unparse(call.args[0]) and "INFO" in ast.unparse(call.args[0]):
            continue
        known = texts(path, call.args[1 if by_level else 0])
        by_error = any(word in ast.unparse(call.args[-1]) for word in ("code", "of_counter"))
        if not any((codes.of_line(text) in CODES) or (text.endswith(" [%s]") and by_error) for text in known):
            bare.append(f"{path}:{call.lineno}: {ast.unparse(call)}")
    assert not bare


def test_each_refusal_has_a_code_by_its_counter() -> None:
    names = {
        text.rstrip("*.")
        for path, call, _ in calls(*REFUSALS)
        for argument in call.args[:2]
        for text in texts(path, argument)
        if re.fullmatch(r"[a-z_*]+(\.[a-z_*]+)+", text)
    }
    assert len(names) > 40
    assert not {
        name
        for name in names - {"*.too_many"}  # of nodes, topics and services
        if codes.of_counter(f"{name}.x") not in CODES or codes.of_counter(f"{name}.x") == "failed"
    }


def test_each_warning_of_a_command_has_a_code() -> None:
    bare = []
    for path, call, of in calls("warn", "print_error"):
        if path.parts[0] != "cli" or of or isinstance(call.args[0], ast.Starred):
            continue
        code = call.args[1] if len(call.args) == 2 else ast.Constant("")
        known = texts(path, code) or ["failed" if "code" in ast.unparse(code) else ""]
        bare += [] if known[0] in CODES else [f"{path}:{call.lineno}"]
    assert not bare


def test_each_check_that_can_fail_has_a_code() -> None:
    named = set[str]()
    for path, call, _ in calls("Check", "from_message", "partial"):
        of_partial = "partial" in ast.unparse(call.func)
        arguments = call.args[1:] if of_partial else call.args
        if of_partial and ast.unparse(call.args[0]) != "Check":
            continue
        well = len(arguments) > 1 and ast.unparse(arguments[1]) in ("OK", "SKIPPED", "UNKNOWN", "STALE")
        if arguments and isinstance(arguments[0], ast.Constant) and not well:
            named |= {*texts(path, arguments[0])}
    assert len(named) > 40
    assert named - codes.CHECKS.keys() == set()
    assert set(codes.CHECKS.values()) | set(codes.PEER_STATES.values()) <= CODES.keys()


def test_each_error_has_a_code_of_the_table() -> None:
    for module in walk_packages(rmpa.__path__, "rmpa."):
        if "__main__" not in module.name:
            try:
                import_module(module.name)
            except (ImportError, RmpaError):  # of an extra
                continue
    kinds = [RmpaError]
    for kind in kinds:
        kinds += kind.__subclasses__()
    assert len(kinds) > 15
    assert not {kind.__name__ for kind in kinds if kind.code not in CODES and kind.code}
    given = {
        str(keyword.value.value)
        for _, node in CALLS
        for keyword in node.keywords
        if keyword.arg == "code" and isinstance(keyword.value, ast.Constant) and isinstance(keyword.value.value, str)
    }
    assert given - {""} <= CODES.keys()


def test_each_code_is_used() -> None:
    rest = "".join((SRC / path).read_text() for path in TREES)
    assert not [code for code in CODES if f'"{code}"' not in rest and f" [{code}]" not in rest]
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)*", code) for code in CODES)


def test_words_that_puzzle_a_reader_do_not_come_back() -> None:
    """docs/design/style.md; the texts are all that are no docstring, and what a command's help shows."""
    puzzling = re.compile(
        r"on the air|stays? home|over there|lives on\b|in its way|stands by\b|told twice|\banew\b|take(s|n)? up"
        r"|joins nothing|all the same[,.]|\bwhoever\b"
    )
    found = [text for about in CODES.values() for text in about if puzzling.search(text)]
    for path, tree in TREES.items():
        nodes = list(ast.walk(tree))
        held = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        verbs = (node for node in nodes if isinstance(node, ast.FunctionDef) and node.decorator_list)
        shown = [ast.get_docstring(verb) or "" for verb in verbs if path.parts[0] == "cli"]
        constants = (node for node in nodes if isinstance(node, ast.Constant) and id(node) not in held)
        shown += [node.value for node in constants if isinstance(node.value, str)]
        found += [f"{path}: {text}" for text in shown if puzzling.search(text)]
    assert not found


def test_an_error_has_the_code_of_its_class_or_that_which_it_is_given() -> None:
    assert ConfigError("--port", "is taken").code == "invalid-value"
    assert ConfigError("--port", "is taken", code="port-in-use").code == "port-in-use"
    assert RmpaError("no").code == "failed"
    assert str(RmpaError("no", code="refused")) == "no"
    assert UnreachableError("ROS master", "http://localhost:11311").code == "master-unreachable"
    assert UnreachableError("broker", "there").code == "unreachable"


@pytest.mark.parametrize("as_json", [False, True])
def test_a_log_line_shows_the_code_of_a_refusal_and_of_a_fault(as_json: bool) -> None:
    root = logging.getLogger()
    before, level, raises = root.handlers[:], root.level, logging.raiseExceptions
    lines = StringIO()
    try:
        configure_logging("info", lines, as_json=as_json)
        log = logging.getLogger("rmpa.mesh")
        RefusalLog(log, Counters()).refuse(0.0, "link.refused.version", "10.0.0.2", "too old")
        try:
            int("x")
        except ValueError:
            log.exception("! a part failed")
    finally:
        root.handlers[:], logging.raiseExceptions = before, raises
        root.setLevel(level)
    refused, fault = lines.getvalue().split("\n")[:2]
    assert "! too old [other-release]" in refused
    assert "! a part failed [internal-error]" in fault
    if as_json:
        assert '"code": "other-release"' in refused


def test_no_two_public_classes_have_one_name() -> None:
    source = Path(rmpa.__path__[0])
    places: defaultdict[str, list[str]] = defaultdict(list)
    for path in sorted(source.rglob("*.py")):
        for item in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(item, ast.ClassDef) and not item.name.startswith("_"):
                places[item.name].append(str(path.relative_to(source)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


SOURCE: Final = Path(rmpa.__path__[0])


def _module(path: Path) -> str:
    parts = ("rmpa", *path.relative_to(SOURCE).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


_HOLDERS: Final = {"rmpa.bridge.bridge": "rmpa.bridge", "rmpa.mesh.io.mesh": "rmpa.mesh.io"}
"""What holds all members of a package, which know each other by it."""


def test_no_modules_import_each_other() -> None:
    modules = {_module(path): ast.parse(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")}
    imports: dict[str, set[str]] = {name: set() for name in modules}
    for name, tree in modules.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("rmpa"):
                members = _HOLDERS.get(node.module, node.module.removesuffix(".part"))
                if members != node.module and name.startswith(f"{members}."):
                    continue  # a member names what holds it, for its type
                found = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
                imports[name] |= found or {node.module}
    assert sum(map(len, imports.values())) > len(modules), "too few imports were found to prove anything"
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle
