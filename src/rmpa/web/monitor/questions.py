"""The answers to questions of pages, and what pages order (``docs/design/monitor-protocol.md``, "Questions")."""

from __future__ import annotations

import asyncio
import functools
import hashlib
import itertools
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import msgspec

from rmpa.bridge.kept import recording_id
from rmpa.bridge.nodes import NODE_INFO
from rmpa.config.peer_rules import Access
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import is_global_name, is_own, proxied_node, proxied_peer
from rmpa.observe import limits as observe_limits
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.operations import PeerParams, parameters_in, remove_recording
from rmpa.observe.snapshot import ModuleFacts
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.descriptor import SERVICE_TYPE
from rmpa.trust.permissions import InviteReply
from rmpa.web.hub.params import as_json, value_at
from rmpa.web.monitor import limits
from rmpa.web.monitor.descriptions import SUFFIX, Descriptions
from rmpa.web.monitor.driving import TYPES
from rmpa.web.monitor.messages import cut_text
from rmpa.web.monitor.state import module_facts, node_key, shown_node

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import ParamValue
    from rmpa.web.monitor.diagnostics import DiagnosticsFeed
    from rmpa.web.monitor.resources import ResourceWatch

_log = logging.getLogger(__name__)


Args: TypeAlias = dict[str, Any]  # the edge: each question has its own
# All questions, each with the right (``Rights``) that a page needs for it; the method ``_QUESTION`` answers it.
QUESTIONS: Final = {
    **dict.fromkeys(("why", "agent", "contract", "node", "describe", "message", "past", "graph", "types"), ""),
    **dict.fromkeys(("driven", "log", "log_levels", "launches", "top"), ""),
    **dict.fromkeys(("params", "param_names", "recordings"), "view"),
    **dict.fromkeys(("keep_recording", "remove_recording"), "control"),
    **dict.fromkeys(
        ("set_param", "delete_param", "set_log_level", "invite", "call", "profile", "context", "configure"), "control"
    ),
    # What programs write, and how they are started, may hold secrets.
    **dict.fromkeys(("launch", "description", "check_description", "save_description"), "control"),
}
_CALL_TIMEOUT: Final = 30.0
_READ_TIMEOUT: Final = 5.0
# Topics that a page offers for its joystick.
_DRIVEN_MAX: Final = 200
_KINDS: Final = ("topic", "service", "module")
# What is done with a resource that a module can start.
_LAUNCHES: Final = ("start", "stop", "restart", "log")
# The service of a resource that takes another configuration (wiki.ros.org/dynamic_reconfigure).
_SET_PARAMETERS: Final = "set_parameters"
# How a page has floats that JSON cannot write.
_NOT_FINITE: Final = ("nan", "inf", "-inf")
# The lists of a ``dynamic_reconfigure/Config`` by the types of parameters.
_LISTS: Final = {"bool": "bools", "int": "ints", "double": "doubles", "str": "strs"}


class Answers:
    """Answers questions; each is asked by a page that may ask it.

    Args:
        hub: Calls services, and has this module's parameters.
        resources: Knows the Smart Resources.
        diagnostics: Knows the past of each status.
        agent: Which agent is asked; empty: the only one.
        environ: Says where the agents' sockets are.
        folder: Where the files that describe this module's resources are; empty for none.
    """

    def __init__(
        self,
        hub: Hub,
        resources: ResourceWatch,
        diagnostics: DiagnosticsFeed,
        agent: Callable[[], str],
        environ: Mapping[str, str],
        folder: str = "",
    ) -> None:
        self._hub = hub
        self._resources = resources
        self._diagnostics = diagnostics
        self._agent_name = agent
        self._environ = environ
        self.descriptions = Descriptions(folder)
        # Each check starts a program: one at a time, and no save between the check and the end of another.
        self._checks = asyncio.Lock()
        self._threads = ThreadPoolExecutor(limits.ANSWERS_AT_ONCE, "rmpa-answers")

    async def answer(self, what: str, args: Args) -> Any:
        """The answer to one of ``QUESTIONS`` that the page may ask, as values for JSON.

        Raises:
            RmpaError: There is none, or the rules deny it; the text says why.
        """
        return await getattr(self, f"_{what}")(args)

    def close(self) -> None:
        """End the threads, once what the agent was asked is answered or has timed out."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _why(self, args: Args) -> Any:
        kind = args.get("kind")
        if kind not in _KINDS:
            raise ConfigError("kind", f"{str(kind)[:40]!r} is not a topic, a service or a module")
        if kind == "module":
            return await self.ask_agent("why", module=_text(args, "name"))
        name, peer = _name(args, "name"), _text(args, "peer")
        return await self.ask_agent("why", name=name, peer=peer or None, service=kind == "service")

    async def _agent(self, args: Args) -> Any:
        answer = await self.ask_agent("agent", peer=_text(args, "peer"))
        return module_facts(msgspec.convert(answer, ModuleFacts))

    async def _contract(self, args: Args) -> Any:
        return await self.ask_agent("contract", topic=_name(args, "topic"), type_name=_text(args, "type"))

    async def _past(self, args: Args) -> Any:
        return self._diagnostics.past(_text(args, "status"))

    async def _graph(self, args: Args) -> Any:
        """The graph of this module's core: each topic with its type and its nodes, proxies included, and services.

        Nothing but its revision where the page ``has`` that one.
        """
        graph = self._hub.graph
        await _in_time(graph.loaded.wait())
        shown = [*islice(graph.topics.values(), limits.TOPICS_SHOWN)]
        topics = {each.name: [" ".join(each.types), each.publishers, each.subscribers] for each in shown}
        return _if_new(args, topics=topics, hidden=len(graph.topics) - len(shown))

    async def _types(self, _args: Args) -> Any:
        """The types of the services of this module's graph, as far as their servers tell them in time, by name."""
        graph = self._hub.graph
        await _in_time(graph.loaded.wait())
        await graph.find_all()
        found = islice((each for each in graph.services.values() if each.type), limits.SERVICES_SHOWN)
        return {each.name: each.type for each in found}

    async def _node(self, args: Args) -> Any:
        """The facts about a node, with names of nodes as pages have them."""
        name, peer = _name(args, "name"), _text(args, "peer")
        if not peer and is_own(name):
            raise RmpaError(f"{name} belongs to the agent of this module; nothing is asked of it")
        about = await self.ask_agent("node", what=NODE_INFO, node=name, **({"peer": peer} if peer else {}))
        for each in about.get("connections") or ():
            other = str(each["other"])
            each["other"] = shown_node(other) if not peer or is_own(other) else node_key(peer, other)
        return about

    async def _log(self, args: Args) -> Any:
        """Log lines of all modules or of ``modules``, of the nodes that the rules let a page see."""
        known = ("modules", "after", "level", "node", "since", "most")
        found = await self.ask_agent("log", **{key: args[key] for key in known if key in args})
        for module in found:
            self._hide(module, "lines", Access.LOG, lambda line: line["node"])
            for line in module["lines"]:
                line["text"] = cut_text(line["text"], limits.LOG_CHARACTERS)
        return found

    def _hide(self, module: Args, what: str, access: Access, name_of: Callable[[Args], str]) -> None:
        """Leave out what the rules let no page see of a module; where nothing is left, its ``problem`` says why."""
        told = [(name_of(each), each) for each in module.get(what, ())]
        denied = {name: why for name in dict(told) if (why := self._denied(access, name))}
        module[what] = [each for name, each in told if name not in denied]
        if denied and not module[what]:
            module["problem"] = next(iter(denied.values()))

    def _denied(self, access: Access, name: str) -> str:
        """Why a page may not do that with what has this name; empty: it may."""
        try:
            self._hub.link.rules.check(access, name)
        except PeerRefused as error:
            return str(error)
        return ""

    async def _log_levels(self, args: Args, change: tuple[str, ...] = ()) -> Any:
        node, more = _name(args, "name"), {key: _text(args, key) for key in ("peer", *change)}
        self._hub.link.rules.check(Access.LOG, node)
        return await self.ask_agent("log_level", node=node, **more)

    _set_log_level = functools.partialmethod(_log_levels, change=("logger", "level"))

    async def _launches(self, _args: Args) -> Any:
        """The resources that each module can start, with their processes; those that the rules let a page start."""
        found = await self.ask_agent("launch", what="list")
        for module in found:
            self._hide(module, "resources", Access.LAUNCH, lambda each: f"/{each['name']}")
        return found

    async def _top(self, _args: Args) -> Any:
        """The processes of the nodes of all modules."""
        return await self.ask_agent("top")

    def _may_launch(self, name: str) -> None:
        self._hub.link.rules.check(Access.LAUNCH, f"/{name}")

    async def _launch(self, args: Args) -> Any:
        """Start, stop or restart a resource of a module, or read its log; that module judges it too."""
        if (what := args.get("do")) not in _LAUNCHES:
            raise ConfigError("do", f"{str(what)[:40]!r} is none of {', '.join(_LAUNCHES)}")
        name, module = _text(args, "name"), _text(args, "module")
        self._may_launch(name)
        asked = {"name": name, "module": module or None, "after": args.get("after"), "lines": args.get("lines")}
        (found,) = await self.ask_agent("launch", what=what, **asked)
        if found["problem"]:
            raise RmpaError(f"{found['module']}: {found['problem']}", code=found["code"])
        return found

    async def _recordings(self, _args: Args) -> Any:
        """What each module has kept, as far as the rules let a page see it, and what its recorder does."""
        found = await self.ask_agent("record", what="list")
        for module in found:
            kept = module.get("kept", ())
            module["kept"] = [each for each in kept if not self._denied(Access.RECORD, f"/{each['id']}")]
            for key in ("messages", "size", "left_out"):  # of each topic
                module.get("status", {}).pop(key, None)
        return found

    async def _keep_recording(self, args: Args) -> Any:
        """Keep what the rings of all modules have; why each that cannot does not."""
        why = _text(args, "why")[: limits.LOG_CHARACTERS]
        self._hub.link.rules.check(Access.RECORD, f"/{recording_id(why, self._agent_name(), time.time_ns())}")
        return await self.ask_agent("record", what="keep", why=why)

    async def _remove_recording(self, args: Args) -> Any:
        name = _text(args, "name")
        self._hub.link.rules.check(Access.RECORD, f"/{name}")
        _, problems = await self._in_thread(lambda client: remove_recording(client, name))
        return problems

    async def _of_file(self, args: Args, do: Callable[..., Any], *keys: str) -> Any:
        file = _text(args, "file")
        self._may_launch(file.removesuffix(SUFFIX))
        call = functools.partial(do, file, *(_text(args, key) for key in keys))
        async with self._checks:
            return await asyncio.get_running_loop().run_in_executor(self._threads, call)

    async def _description(self, args: Args) -> Any:
        return await self._of_file(args, self.descriptions.read)

    async def _check_description(self, args: Args) -> Any:
        return {"problems": await self._of_file(args, self.descriptions.check, "text")}

    async def _save_description(self, args: Args) -> Any:
        return await self._of_file(args, self.descriptions.save, "text", "digest")

    async def ask_agent(self, op: str, **args: object) -> Any:
        """Call an operation of the agent."""
        return await self._in_thread(lambda client: client.call(op, object, **args))

    async def _of_peer(self, peer: str, do: Callable[[PeerParams], Any]) -> Any:
        return await self._in_thread(lambda client: do(PeerParams(client, peer)))

    async def _in_thread(self, do: Callable[[ControlClient], Any]) -> Any:
        def ask() -> Any:
            agent = choose_agent(self._environ, self._agent_name() or None)
            with ControlClient(agent.path, observe_limits.CONTROL_HANDLER_TIMEOUT) as client:
                return do(client)

        return await asyncio.get_running_loop().run_in_executor(self._threads, ask)

    async def _describe(self, args: Args) -> Any:
        kind = await self._type_of(self._service(args))
        empty = codec_for(kind.request)
        example = empty.write({}, 0).payload
        return {
            "type": kind.name,
            "text": f"{kind.request.definition.strip()}\n---\n{kind.response.definition.strip()}".strip(),
            "request": msgspec.json.decode(empty.json(memoryview(example))),
        }

    async def _message(self, args: Args) -> Any:
        """The fields of a message type, and of all that it embeds, for a form; -1: an array of any length."""
        kind = await self._hub.types.find_message(_text(args, "type"))
        sizes = {name: one.fields for name, one in codec_for(kind).known.items()}
        types = {
            name: [[each.name, each.type, (-1 if each.size is None else each.size) if each.array else None]
                   for each in fields]
            for name, fields in sizes.items()
        }  # fmt: skip
        return {"type": kind.name, "text": kind.definition.strip(), "types": types}

    async def _driven(self, _args: Args) -> Any:
        """The topics that a joystick can drive, each with its type and the nodes that subscribe to it."""
        own = self._hub.link.node.name if self._hub.link.node is not None else ""
        found: dict[str, Any] = {}
        for topic in self._hub.graph.topics.values():
            if (type_ := next((each for each in topic.types if each in TYPES), "")) and len(found) < _DRIVEN_MAX:
                nodes = (each for each in topic.subscribers if each != own)
                nodes = (each for each in nodes if proxied_node(each) or not is_own(each))
                found[topic.name] = {"type": type_, "nodes": sorted(map(shown_node, nodes))}
        return {"topics": found, "types": [*TYPES]}

    async def _params(self, args: Args) -> Any:
        """All parameters that the rules let a page see, with their digest; none to a page that ``has`` that one.

        A peer's count by their names there.
        """
        peer = _text(args, "peer")
        tree = await self._of_peer(peer, lambda params: params.get("/")) if peer else await self._own_params()
        return _if_new(
            args, values=self._hub.link.rules.visible_tree(as_json(tree, lambda data: f"{len(data)} bytes"))
        )

    async def _own_params(self) -> Mapping[str, ParamValue]:
        self._hub.link.need()
        await _in_time(self._hub.params.loaded.wait())
        return self._hub.params.tree

    async def _param_names(self, _args: Args) -> Any:
        await self._own_params()
        names = islice(self._hub.params.values(), 5000)
        return {"names": sorted(self._hub.link.rules.visible(dict.fromkeys(names)))}

    async def _set_param(self, args: Args) -> Any:
        if args.get("value") is None:
            raise ConfigError("value", "a parameter cannot be null", "delete it instead")
        return await self._change(args, args["value"])

    async def _delete_param(self, args: Args) -> Any:
        if _name(args, "name") == "/":
            raise ConfigError("name", "the root holds every parameter", "name the one that you mean")
        return await self._change(args, None)

    async def _change(self, args: Args, value: ParamValue) -> Any:
        """Set a parameter, or delete it where ``value`` is ``None``; returns all of them."""
        name, peer, rules = _name(args, "name"), _text(args, "peer"), self._hub.link.rules
        if peer:

            def change(params: PeerParams) -> None:
                # The peer judges what this module may do, and knows nothing of rmpa web. Where it hides some of its
                # parameters from this module, a page changes none of them: what a namespace holds is not known.
                if rules.permissions is not None:
                    tree = params.get("/")
                    rules.check_param_change(name, lambda each: cast("ParamValue", value_at(tree, each, None)), value)
                if value is None:
                    params.delete(name)
                else:
                    present = params.get(name) if name in params.names() else None
                    params.set(name, cast("XmlRpcValue", _as_before(name, present, value)))

            await self._of_peer(peer, change)
        elif value is None:
            await _in_time(self._hub.params.delete(name))
        else:
            await self._own_params()
            kept = _as_before(name, self._hub.params.value(name), value)
            parameters_in(name, cast("XmlRpcValue", kept))
            await _in_time(self._hub.params.set(name, cast("ParamValue", kept)))
        return await self._params(args)

    async def _invite(self, args: Args) -> Any:
        """An invitation for a module that is pending; the answer is a secret, for the page that asks alone."""
        name = _text(args, "name")

        def invite(client: ControlClient) -> InviteReply:
            if not any(one.invite and one.name == name for one in client.snapshot(topics=()).strangers):
                raise RmpaError(f"no module {name[:80]!r} is pending")
            return client.call("trust", InviteReply, what="invite", name=name)

        made: InviteReply = await self._in_thread(invite)
        _log.info("= a page has made an invitation for %s", name)
        return {"line": f"rmpa trust join {made.token}", "until": made.expires}

    async def _call(self, args: Args) -> Any:
        service = self._service(args)
        kind = await self._type_of(service)
        began = time.monotonic()
        response = await self._call_service(service, kind, args.get("request", {}))
        return {"response": response, "seconds": round(time.monotonic() - began, 6)}

    async def _call_service(self, service: str, kind: ServiceType, request: Any) -> Any:
        body = codec_for(kind.request).write_arguments(request, time.time_ns()).payload
        response = await self._hub.calls.call(service, kind.md5sum, body, _CALL_TIMEOUT)
        return msgspec.json.decode(codec_for(kind.response).json(memoryview(response)))

    async def _configure(self, args: Args) -> Any:
        resource, name, value = _name(args, "resource"), _text(args, "name"), args.get("value")
        facts = self._resources.facts.get(node_key(_text(args, "peer"), resource))
        known = facts.descriptor.get("parameters", ()) if facts is not None else ()
        kind = next((each["type"] for each in known if each.get("name") == name), None)
        if kind not in _LISTS:
            raise ConfigError("name", f"{resource} has no parameter {name[:80]!r}")
        if not _is_of(kind, value):
            raise ConfigError(name, f"{str(value)[:40]!r} is no value of the type {kind}")
        config = await self._reconfigure(args, {_LISTS[kind]: [{"name": name, "value": value}]})
        taken = next((each["value"] for each in config[_LISTS[kind]] if each["name"] == name), value)
        text = f"{name} is {_written(taken)}" + (
            "" if taken == value else f": {_written(value)} is beyond its bounds"
        )
        return {"value": taken, "text": text}

    async def _reconfigure(self, args: Args, config: Args) -> Args:
        """Ask a resource for another configuration; returns the one that it has then."""
        resource = _name(args, "resource")
        service = self._service({"service": f"{resource}/{_SET_PARAMETERS}", "peer": args.get("peer", "")})
        kind = self._hub.types.service(SERVICE_TYPE)
        taken: Args = (await self._call_service(service, kind, {"config": config}))["config"]
        return taken

    async def _choose(self, args: Args, what: str) -> Any:
        choice = _text(args, "choice")
        await self._reconfigure(args, {"strs": [{"name": what, "value": choice}]})
        return {"text": f"{what} {choice} is chosen" if choice else f"the resource chooses its {what}"}

    _profile = functools.partialmethod(_choose, what="profile")
    _context = functools.partialmethod(_choose, what="context")

    def _service(self, args: Args) -> str:
        """The service that is meant, which this module's graph has and, if a peer is named, by that peer.

        Raises:
            RmpaError: There is none.
        """
        name, peer = _name(args, "service"), _text(args, "peer")
        known = self._hub.graph.services.get(name)
        if known is None:
            raise RmpaError(f"the graph of this module has no service {name}", code="unknown-name")
        peers = [proxied_peer(node) or "" for node in known.providers]
        if peers and peer not in peers:
            whose = peers[0] or "this module"
            raise RmpaError(f"the service {name} of {whose} has this name here, not that of {peer or 'this module'}")
        return name

    async def _type_of(self, service: str) -> ServiceType:
        type_, _ = await self._hub.calls.find(service)
        return await self._hub.types.find_service(type_)


async def _in_time(done: Awaitable[Any]) -> None:
    """Wait for the core's parameters.

    Raises:
        RmpaError: They are not known in time, or what is done with them fails.
    """
    try:
        async with asyncio.timeout(_READ_TIMEOUT):
            await done
    except TimeoutError:
        raise UnreachableError("parameters of the core", "its API", "is it busy? ask again") from None


def _if_new(args: Args, **values: object) -> Args:
    """Values with their digest; that alone for a page that ``has`` it."""
    digest = hashlib.sha256(msgspec.json.encode(values, order="sorted")).hexdigest()[:16]
    return {"digest": digest} if args.get("has") == digest else {"digest": digest, **values}


def _as_before(name: str, present: object, value: object) -> object:
    """A new value of a parameter, a float where it was one: a page writes 1.0 as 1, and has NaN as a text.

    Raises:
        ConfigError: The present value is binary data, of which a page shows only the length.
    """
    if isinstance(present, bytes | bytearray | memoryview):
        raise ConfigError(name, "it holds binary data", "set it with `rmpa param set -b FILE`")
    if isinstance(present, float):
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        return float(cast("float", value)) if is_whole or value in _NOT_FINITE else value
    if isinstance(present, list | tuple) and isinstance(value, list) and present:
        pairs = itertools.zip_longest(value, present[: len(value)], fillvalue=present[-1])
        return [_as_before(name, before, each) for each, before in pairs]
    if isinstance(present, dict) and isinstance(value, dict):
        return {key: _as_before(name, present.get(key), each) for key, each in value.items()}
    return value


def _is_of(kind: str, value: object) -> bool:
    """Whether a value for JSON is one of this type of a parameter: nothing is read into another one."""
    if isinstance(value, bool):
        return kind == "bool"
    return isinstance(value, {"bool": bool, "str": str, "int": int}.get(kind, int | float))


def _written(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _text(args: Args, key: str) -> str:
    value = args.get(key, "")
    if not isinstance(value, str):
        raise ConfigError(key, f"{str(value)[:40]!r} is not a text")
    return value


def _name(args: Args, key: str) -> str:
    value = _text(args, key)
    if value != "/" and not is_global_name(value):
        raise ConfigError(key, f"{value[:80]!r} is not a name", "write it as /name")
    return value
