"""``rmpa param``: reads and writes parameters of a master or of a peer's module."""

from __future__ import annotations

import base64
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rmpa.cli.options import GraphOptions, agent_option, completes, graph_options, json_option
from rmpa.cli.output import Column, json_text, print_json, print_line, print_table, printable, size, warn
from rmpa.cli.param_store import open_store, read_key, split_peer
from rmpa.cli.param_yaml import read_documents, read_yaml, show_yaml, write_yaml
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.snapshot import FollowedInfo

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

peer_option = click.option(
    "--peer",
    metavar="PEER",
    shell_complete=completes("peer"),
    help="The parameters of this peer's module (or its GUID); SITE/MODULE: of another site's.",
)


def _json(value: Any) -> Any:
    """A value for JSON: binary data in base64, dates in ISO 8601."""
    if isinstance(value, dict):
        return {name: _json(member) for name, member in value.items()}
    if isinstance(value, list):
        return [_json(member) for member in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return value.isoformat() if isinstance(value, datetime) else value


@click.command(
    epilog="""\
\b
Examples:
  rmpa param get /robot_description
  rmpa param get /base --json
  rmpa param get base:/run_id          as --peer base /run_id
"""
)
@click.argument("key", shell_complete=completes("param"))
@click.option("-p", "--pretty", is_flag=True, help="A string as it is, without YAML's quotes and folding.")
@peer_option
@graph_options
def get(key: str, pretty: bool, peer: str | None, options: GraphOptions) -> None:
    """Print the parameter KEY, or all of the namespace KEY, as YAML."""
    peer, key = split_peer(peer, key)
    value = open_store(peer, options).get(read_key(key, os.environ))
    if options.as_json:
        print_json(_json(value))
    elif pretty and isinstance(value, str):
        click.echo("\n".join(printable(line) for line in value.split("\n")))
    else:
        click.echo(show_yaml(value), nl=False)


@click.command(
    "set",
    context_settings={"ignore_unknown_options": True},
    epilog="""\
\b
Examples:
  rmpa param set /speed 1.5
  rmpa param set /gains '{p: 1.0, i: 0.1}'
  rmpa param set /angle 'deg(90)'
  rmpa param set --peer base /base/max_speed 0.4
  rmpa param set /robot_description -t robot.urdf
""",
)
@click.argument("key", shell_complete=completes("param"))
@click.argument("value", required=False)
@click.option("-t", "--textfile", metavar="FILE", help="Set it to this file's text.")
@click.option("-b", "--binfile", metavar="FILE", help="Set it to this file's bytes.")
@peer_option
@graph_options
def set_(
    key: str, value: str | None, textfile: str | None, binfile: str | None, peer: str | None, options: GraphOptions
) -> None:
    """Set the parameter KEY to the YAML VALUE.

    A dictionary sets each of its members; others of the namespace stay as they are.
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
    count = open_store(peer, options).set(name, found)
    if options.as_json:
        print_json({"key": name, "set": count})


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa param list\n  rmpa param list /base\n  rmpa param list --peer base --json\n"
)
@click.argument("namespace", default="", shell_complete=completes("param"))
@peer_option
@graph_options
def list_(namespace: str, peer: str | None, options: GraphOptions) -> None:
    """List the names of all parameters, or of those in NAMESPACE."""
    peer, namespace = split_peer(peer, namespace)
    key = read_key(namespace, os.environ) if namespace else "/"
    begin = "/" if key == "/" else f"{key}/"
    names = [name for name in open_store(peer, options).names() if name.startswith(begin)]
    if options.as_json:
        print_json(names)
    else:
        for name in names:
            print_line(name)


@click.command(epilog="\b\nExamples:\n  rmpa param delete /speed\n  rmpa param delete --peer base /base/trial\n")
@click.argument("key", shell_complete=completes("param"))
@peer_option
@graph_options
def delete(key: str, peer: str | None, options: GraphOptions) -> None:
    """Delete the parameter KEY, or all of the namespace KEY."""
    peer, key = split_peer(peer, key)
    name = read_key(key, os.environ)
    if name == "/":
        raise ConfigError("KEY", "the root holds every parameter", "name the one that you mean")
    open_store(peer, options).delete(name)
    if options.as_json:
        print_json({"key": name, "deleted": True})


@click.command(
    epilog="""\
\b
Examples:
  rmpa param dump robot.yaml
  rmpa param dump - /base | less
  rmpa param dump --peer base base.yaml /base
"""
)
@click.argument("file", default="-")
@click.argument("namespace", default="", shell_complete=completes("param"))
@peer_option
@graph_options
def dump(file: str, namespace: str, peer: str | None, options: GraphOptions) -> None:
    """Write all parameters, or those in NAMESPACE, as YAML to FILE, or to standard output (-)."""
    peer, namespace = split_peer(peer, namespace)
    value = open_store(peer, options).get(read_key(namespace, os.environ, root=True))
    if file == "-":
        if options.as_json:
            print_json(_json(value))
        else:
            click.echo(write_yaml(value), nl=False)
        return
    text = json_text(_json(value)) + "\n" if options.as_json else write_yaml(value)
    try:
        Path(file).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RmpaError(f"{file} cannot be written: {error.strerror}") from None


@click.command(
    epilog="""\
\b
Examples:
  rmpa param load robot.yaml
  rmpa param load gains.yaml /base
  rmpa param dump --peer base - | rmpa param load - /copy_of_base
"""
)
@click.argument("file")
@click.argument("namespace", default="", shell_complete=completes("param"))
@peer_option
@graph_options
def load(file: str, namespace: str, peer: str | None, options: GraphOptions) -> None:
    """Set the parameters of a YAML FILE (- for standard input), below NAMESPACE if one is given.

    As in rosparam, a key _ns of a document is a namespace for all of it.
    """
    peer, namespace = split_peer(peer, namespace)
    documents = [_placed(document, namespace, file) for document in read_documents(_text(file), file)]
    store = open_store(peer, options)
    count = sum(store.set(key, value) for key, value in documents)
    if options.as_json:
        print_json({"set": count})


def _placed(document: XmlRpcValue, namespace: str, file: str) -> tuple[str, XmlRpcValue]:
    """The namespace of a document, and its parameters."""
    if not isinstance(document, dict):
        raise RmpaError(f"{file}: a document is {str(document)[:60]!r}, not a dictionary of parameters")
    value = dict(document)
    inner = value.pop("_ns", "")
    if not isinstance(inner, str):
        raise RmpaError(f"{file}: _ns is {inner!r}, not a namespace")
    key = read_key(namespace, os.environ, root=True)
    if inner:
        key = read_key(inner if inner.startswith("/") else f"{key.rstrip('/')}/{inner}", os.environ)
    return key, value


def _read(file: str) -> bytes:
    try:
        return sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise RmpaError(f"{file} cannot be read: {error.strerror}") from None


def _text(file: str) -> str:
    try:
        return _read(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RmpaError(f"{file}: byte {error.start} is not UTF-8; set binary data with -b") from None


@click.command(epilog="\b\nExamples:\n  rmpa param followed\n  rmpa param followed --json\n")
@json_option
@agent_option
def followed(as_json: bool, agent: str | None) -> None:
    """List the parameters of other modules that this one follows ([[param]] and [time] of rmpa.toml)."""
    with ControlClient(choose_agent(os.environ, agent).path) as client:
        found = client.call("followed", tuple[FollowedInfo, ...])
    if as_json:
        print_json(found)
        return
    if not found:
        click.echo(f"{client.name} follows no parameters: [[param]] in rmpa.toml names some")
        return
    columns = (Column("KEY"), Column("STATE"), Column("OWNER"), Column("SIZE", right=True))
    colours = [{"followed": "green", "refused": "red"}.get(one.state, "yellow") for one in found]
    rows = [[one.key, one.state, f"{one.owner}:{one.owner_key}", size(one.size)] for one in found]
    print_table(columns, rows, colours=colours)
    for one in found:
        if one.problem:
            warn(f"{one.key}: {one.problem}")
