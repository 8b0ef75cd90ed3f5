"""``rmpa param``: reads and writes parameters of a master or of a peer's module."""

from __future__ import annotations

import ast
import asyncio
import math
import operator
import os
import re
import sys
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import click
import yaml

from rmpa.bridge.params.owner import key_problem
from rmpa.cli.graph import CALLER_ID, Master, suggestion
from rmpa.cli.options import Options, agent_verb, argument, flag, graph_verb, option, options_of, peers
from rmpa.cli.output import Painted, Table, Text, json_text, size, warn
from rmpa.config.rules import ROS2
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.facts import FollowedInfo
from rmpa.core.identity import is_legal_name, resolve_name
from rmpa.observe import limits as observe_limits
from rmpa.observe.operations import PeerParams, Ros2Params, parameters_in
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

# Seconds for one call of a master: it may bring megabytes of XML, from a busy machine.
_FOR_ALL: Final = 30.0
_INT_MAX: Final = (1 << 31) - 1
_OPERATORS: Final[dict[type[ast.AST], Callable[..., float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


def param_names(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Parameters, and namespaces of them, for ``options.completes``."""
    before = incomplete.partition(":")[0] + ":" if ":" in incomplete else ""
    peer, _ = split_peer(ctx.params.get("peer"), incomplete)
    for name in open_store(peer, options_of(ctx)).names():
        yield from (before + each for each in with_namespaces(name))  # rosparam's verbs take namespaces too


peer_option: Final = option(
    "--peer", "PEER", "The parameters of this peer's module (or its GUID); ros2/NODE: of a node of ROS 2.", find=peers
)


@dataclass
class MasterParams:
    """The parameters of a ROS master, an agent's core or any other; as ``PeerParams``."""

    master: Master

    def get(self, key: str) -> XmlRpcValue:
        """A value, or a namespace.

        Raises:
            RmpaError: There is none; the text offers the nearest name.
        """
        return self._known("getParam", key).value

    def names(self) -> list[str]:
        """The names of all parameters, in order."""
        value = self._call("getParamNames").value
        return sorted(str(name) for name in value) if isinstance(value, list) else []

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a namespace; return the number. If one cannot be set, none is."""
        from rmpa.ros.wire.xmlrpc import serialize_response

        parameters = parameters_in(key, value)
        serialize_response(value)  # a value that XML-RPC cannot hold is an error before anything is set
        for name, one in parameters:
            reply = self._call("setParam", name, one)
            if reply.code != 1:
                raise RmpaError(f"{self.master.uri} does not set {name}: {reply.status}", code="refused")
        return len(parameters)

    def delete(self, key: str) -> None:
        """Delete a parameter or namespace.

        Raises:
            RmpaError: There is none.
        """
        self._known("deleteParam", key)

    def _known(self, method: str, key: str) -> RosReply:
        reply = self._call(method, key)
        if reply.code != 1:
            known = {name for full in self.names() for name in with_namespaces(full)}
            problem = f"{self.master.uri} has no parameter {key}; {suggestion(key, known, '`rmpa param list`')}"
            raise RmpaError(problem, code="unknown-name")
        return reply

    def _call(self, method: str, *params: XmlRpcValue) -> RosReply:
        from rmpa.ros.http.rpc import call_api

        try:
            return asyncio.run(call_api(self.master.uri, method, CALLER_ID, *params, timeout=_FOR_ALL))
        except UnreachableError:
            raise self.master.unreachable() from None


ParamStore: TypeAlias = MasterParams | PeerParams | Ros2Params


def with_namespaces(name: str) -> list[str]:
    """A parameter's name, and those of the namespaces that it is in."""
    parts = name.split("/")
    return ["/".join(parts[:end]) for end in range(2, len(parts) + 1)]


def open_store(peer: str | None, options: Options) -> ParamStore:
    """The parameters that the options name.

    Args:
        peer: The peer whose module is meant; ``None``: a master's parameters.
        options: Master and agent.

    Raises:
        ConfigError: Both ``--peer`` and ``--master`` are given.
        RmpaError: There is no such agent, or the peer is another site's, from which parameters do not cross.
    """
    if peer is None:
        return MasterParams(options.master())
    if options.master_uri is not None:
        raise ConfigError("--peer", "a peer is asked through this machine's agent, not at a master", "leave one out")
    site, slash, node = peer.partition("/")
    if slash and site != ROS2:
        remedy = "run `rmpa param` at that site, or have a service, a latched topic or dynamic_reconfigure bring it"
        raise RmpaError(f"{peer}: parameters do not cross between sites; {remedy}", code="not-offered")
    client = options.client(observe_limits.CONTROL_HANDLER_TIMEOUT)
    if context := click.get_current_context(silent=True):
        context.with_resource(client)
    return Ros2Params(client, f"/{node.strip('/')}") if slash else PeerParams(client, peer)


def split_peer(peer: str | None, text: str) -> tuple[str | None, str]:
    """The peer and the name that are meant, by ``--peer`` or as ``PEER:/name``.

    Args:
        peer: The option's value.
        text: What the user wrote as the name; a parameter's own name has no colon.

    Raises:
        ConfigError: Both name a peer.
    """
    before, colon, name = text.partition(":")
    if not colon or not before:
        return peer, text
    if peer is not None:
        raise ConfigError("--peer", f"{text!r} names a peer too", "leave one out")
    return before, name or "/"


def read_key(text: str, environ: Mapping[str, str], *, root: bool = False) -> str:
    """The global name of a parameter; a relative one is resolved in ROS_NAMESPACE.

    Args:
        text: What the user wrote.
        environ: The environment.
        root: Whether an empty text means the whole namespace.

    Raises:
        ConfigError: It is no parameter's name.
    """
    namespace = environ.get("ROS_NAMESPACE") or "/"
    if not text and root:
        return resolve_name("", namespace if is_legal_name(namespace) else "/")
    if text.startswith("~"):
        raise ConfigError("KEY", f"{text!r} is private to a node", "write the node's name in front: /node/name")
    key = text if text.startswith("/") else f"{namespace.rstrip('/')}/{text}"
    key = "/" + key.strip("/")
    if problem := key_problem(key):
        raise ConfigError("KEY", problem, "one looks like /robot_description")
    return key


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with rosparam's angles: ``deg(90)``, ``rad(pi/2)``, ``!degrees 90``, ``!radians pi/2``.

    A key that stands twice in one mapping is an error: PyYAML alone would silently drop the first value.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping's values by key.

        Raises:
            yaml.constructor.ConstructorError: A key stands twice; with its place.
        """
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    problem = f"found duplicate key {key.value!r}"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """PyYAML's safe dumper without anchors: two equal lists are two lists in the parameter server."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - PyYAML's signature
        """Whether each value is written in full."""
        return True


def _construct_value(loader: _Loader, node: yaml.ScalarNode) -> str:
    """The text of a lone ``=``: PyYAML resolves it to a type that it cannot construct."""
    return str(loader.construct_scalar(node))


def _construct_angle(loader: _Loader, node: yaml.ScalarNode) -> float:
    """The angle in radians.

    Raises:
        yaml.constructor.ConstructorError: The text is no angle; with its place.
    """
    text = str(loader.construct_scalar(node)).strip()
    inner = re.sub(r"^(?:deg|rad)\((.*)\)$", r"\1", text)
    try:
        angle = _calculate(ast.parse(inner.strip(), mode="eval").body)
    except (SyntaxError, ValueError, ZeroDivisionError, OverflowError, RecursionError, MemoryError):
        problem = f"{text!r} is not an angle: one looks like deg(90) or rad(pi/2)"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None
    return math.radians(angle) if node.tag == "!degrees" else angle


_Loader.add_constructor("tag:yaml.org,2002:value", _construct_value)
for _tag, _first, _pattern in (("!degrees", "d", r"^deg\([^)]*\)$"), ("!radians", "r", r"^rad\([^)]*\)$")):
    _Loader.add_constructor(_tag, _construct_angle)
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), [_first])


def _calculate(node: ast.AST) -> float:
    """The value of an expression of numbers and ``pi``."""
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.Name(id="pi"):
            return math.pi
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _OPERATORS:
            return _OPERATORS[type(sign)](_calculate(operand))
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
            return _OPERATORS[type(sign)](_calculate(left), _calculate(right))
    raise ValueError("not a number")


def read_yaml(text: str, where: str) -> XmlRpcValue:
    """The value of a YAML text; an empty text is an empty string, since the shell removes the quotes.

    Raises:
        RmpaError: It is not YAML, or cannot be a parameter: with ``where``, line and column.
    """
    return next(iter(read_documents(text or "''", where)), "")


def read_documents(text: str, where: str) -> list[XmlRpcValue]:
    """The values of all documents of a YAML text.

    Raises:
        RmpaError: As for ``read_yaml``.
    """
    if len(text) > ros_limits.HTTP_BODY_MAX:
        bound = f"{ros_limits.HTTP_BODY_MAX} ({ros_limits.HTTP_BODY_MAX >> 20} MiB)"
        said = f"{where}: {len(text)} characters, above the {bound} that a core takes at once; split it"
        raise RmpaError(said, code="limit-reached")
    try:
        documents = list(yaml.load_all(text, _Loader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = str(getattr(error, "problem", None) or error).splitlines()[0]
        raise RmpaError(f"{where}{_place(error)}: not YAML: {problem}", code="invalid-value") from None
    return [_storable(document, where) for document in documents]


def _place(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    return f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""


def _storable(value: Any, where: str, key: str = "", depth: int = 0) -> Any:
    """A value in the types of XML-RPC, where a date always has a time.

    Raises:
        RmpaError: No parameter can hold it, or a part of it: with ``where`` and the part's key.
    """
    problem = ""
    if depth > ros_limits.PARAM_DEPTH_MAX:
        key, problem = key.partition("[")[0], f"nested deeper than {ros_limits.PARAM_DEPTH_MAX} levels"
    elif isinstance(value, dict):
        strange = [name for name in value if not isinstance(name, str)]
        if not strange:
            return {name: _storable(each, where, f"{key}/{name}", depth + 1) for name, each in value.items()}
        problem = f"the key {strange[0]!r} is not a string; put it in quotes"
    elif isinstance(value, list | tuple):
        return [_storable(each, where, f"{key}[{index}]", depth + 1) for index, each in enumerate(value)]
    elif value is None:
        problem = "null is no value of a parameter; write '' for an empty string, or leave it out"
    elif isinstance(value, int) and not isinstance(value, bool) and not -_INT_MAX - 1 <= value <= _INT_MAX:
        problem = f"{value} does not fit the 32 bits of a parameter; write it with a point, or in quotes"
    elif isinstance(value, date) and not isinstance(value, datetime):
        return datetime(value.year, value.month, value.day)  # noqa: DTZ001 - XML-RPC's dates have no zone
    elif not isinstance(value, bool | int | float | str | bytes | date):
        problem = f"a {type(value).__name__} cannot be a parameter"
    if problem:
        raise RmpaError(f"{where}: {f'{key}: ' if key else ''}{problem}", code="invalid-value")
    return value


def write_yaml(value: XmlRpcValue) -> str:
    """A value as ``rosparam dump`` writes it, keys in order."""
    return yaml.dump(value, Dumper=_Dumper, default_flow_style=False)


def param_verb(*parameters: Any, **settings: Any) -> Callable[[Callable[..., None]], click.Command]:
    """A ``graph_verb`` with ``--peer``."""
    return graph_verb(*parameters, peer_option, **settings)


@param_verb(
    argument("key", param_names), flag("-p --pretty", "Print a string as it is, without YAML's quotes and folding.")
)
def param_get(key: str, pretty: bool, peer: str | None, options: Options) -> None:
    """Print the parameter KEY, or all of the namespace KEY, as YAML.

    ---

    Examples:
      rmpa param get /robot_description
      rmpa param get /base --json
      rmpa param get base:/run_id          as --peer base /run_id
    """
    peer, key = split_peer(peer, key)
    value = open_store(peer, options).get(read_key(key, os.environ))
    if pretty and isinstance(value, str):
        options.show(value, value.split("\n"))
    else:
        # As rosparam get: without the "..." that ends a document of one scalar.
        options.show(value, Painted(write_yaml(value).removesuffix("...\n").rstrip("\n")))


@param_verb(
    argument("key", param_names),
    argument("value", required=False),
    option("-t --textfile", "FILE", "Set it to this file's text."),
    option("-b --binfile", "FILE", "Set it to this file's bytes."),
    context_settings={"ignore_unknown_options": True},
)
def param_set(
    key: str, value: str | None, textfile: str | None, binfile: str | None, peer: str | None, options: Options
) -> None:
    """Set the parameter KEY to the YAML VALUE.

    A dictionary sets each of its members; others of the namespace stay as they are.

    ---

    Examples:
      rmpa param set /speed 1.5
      rmpa param set /gains '{p: 1.0, i: 0.1}'
      rmpa param set /angle 'deg(90)'
      rmpa param set --peer base /base/max_speed 0.4
      rmpa param set /robot_description -t robot.urdf
    """
    peer, key = split_peer(peer, key)
    given = [word for word in (value, textfile, binfile) if word is not None]
    if len(given) != 1:
        raise ConfigError("VALUE", "none is given" if not given else "two are given", "one of VALUE, -t and -b")
    found: XmlRpcValue
    if binfile is not None:
        found = _read(binfile)
    elif textfile is not None:
        found = _text(textfile)
    else:
        found = read_yaml(value or "", "VALUE")
    name = read_key(key, os.environ, root=True)
    options.show({"key": name, "set": open_store(peer, options).set(name, found)})


@param_verb(argument("namespace", param_names, default=""))
def param_list(namespace: str, peer: str | None, options: Options) -> None:
    """List the names of all parameters, or of those in NAMESPACE.

    ---

    Examples:
      rmpa param list
      rmpa param list /base
      rmpa param list --peer base --json
    """
    peer, namespace = split_peer(peer, namespace)
    key = read_key(namespace, os.environ) if namespace else "/"
    begin = "/" if key == "/" else f"{key}/"
    names = [name for name in open_store(peer, options).names() if name.startswith(begin)]
    options.show(names, names)


@param_verb(argument("key", param_names))
def param_delete(key: str, peer: str | None, options: Options) -> None:
    """Delete the parameter KEY, or all of the namespace KEY.

    ---

    Examples:
      rmpa param delete /speed
      rmpa param delete --peer base /base/trial
    """
    peer, key = split_peer(peer, key)
    name = read_key(key, os.environ)
    if name == "/":
        raise ConfigError("KEY", "the root holds every parameter", "name the one that you mean")
    open_store(peer, options).delete(name)
    options.show({"key": name, "deleted": True})


@param_verb(argument("file", default="-"), argument("namespace", param_names, default=""))
def param_dump(file: str, namespace: str, peer: str | None, options: Options) -> None:
    """Write all parameters, or those in NAMESPACE, as YAML to FILE, or to standard output (-).

    ---

    Examples:
      rmpa param dump robot.yaml
      rmpa param dump - /base | less
      rmpa param dump --peer base base.yaml /base
    """
    peer, namespace = split_peer(peer, namespace)
    value = open_store(peer, options).get(read_key(namespace, os.environ, root=True))
    text = json_text(value) + "\n" if options.as_json else write_yaml(value)
    if file == "-":
        click.echo(text, nl=False)
        return
    try:
        Path(file).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RmpaError(f"{file} cannot be written: {error.strerror}", code="directory-unusable") from None


@param_verb(argument("file"), argument("namespace", param_names, default=""))
def param_load(file: str, namespace: str, peer: str | None, options: Options) -> None:
    """Set the parameters of a YAML FILE (- for standard input), below NAMESPACE if one is given.

    As in rosparam, a key _ns of a document is a namespace for all of it.

    ---

    Examples:
      rmpa param load robot.yaml
      rmpa param load gains.yaml /base
      rmpa param dump --peer base - | rmpa param load - /copy_of_base
    """
    peer, namespace = split_peer(peer, namespace)
    documents = [_placed(document, namespace, file) for document in read_documents(_text(file), file)]
    store = open_store(peer, options)
    options.show({"set": sum(store.set(key, value) for key, value in documents)})


def _placed(document: XmlRpcValue, namespace: str, file: str) -> tuple[str, XmlRpcValue]:
    """The namespace of a document, and its parameters."""
    if not isinstance(document, dict):
        problem = f"{file}: a document is {str(document)[:60]!r}, not a dictionary of parameters"
        raise RmpaError(problem, code="invalid-value")
    value = dict(document)
    inner = value.pop("_ns", "")
    if not isinstance(inner, str):
        raise RmpaError(f"{file}: _ns is {inner!r}, not a namespace", code="invalid-value")
    key = read_key(namespace, os.environ, root=True)
    if inner:
        key = read_key(inner if inner.startswith("/") else f"{key.rstrip('/')}/{inner}", os.environ)
    return key, value


def _read(file: str) -> bytes:
    try:
        return sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise RmpaError(f"{file} cannot be read: {error.strerror}", code="directory-unusable") from None


def _text(file: str) -> str:
    try:
        return _read(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problem = f"{file}: byte {error.start} is not UTF-8; set binary data with -b"
        raise RmpaError(problem, code="invalid-value") from None


@agent_verb()
def param_followed(options: Options) -> None:
    """List the parameters of other modules that this one follows ([[param]] and [time] of rmpa.toml).

    ---

    Examples:
      rmpa param followed
      rmpa param followed --json
    """
    with options.client() as client:
        found = client.call("followed", tuple[FollowedInfo, ...])

    def text() -> Iterator[Text]:
        if not found:
            yield f"{client.name} follows no parameters: [[param]] in rmpa.toml names some"
            return
        colours = [{"followed": "green", "refused": "red"}.get(one.state, "yellow") for one in found]
        rows = [[one.key, one.state, f"{one.owner}:{one.owner_key}", size(one.size)] for one in found]
        yield Table("KEY, STATE, OWNER, >SIZE", rows, colours)
        for one in found:
            if one.problem:
                warn(f"{one.key}: {one.problem}", "param-trouble")

    options.show(found, text())
