"""A node of ROS 2 with parameters, and a client of ``ros2 param``'s services, in rmw_zenoh's format.

Runs with RMPA's interpreter, and uses its types of rcl_interfaces: ``ros2_param_end.py ENDPOINT``. Reads JSON:

* ``{"do": "serve", "values"}``: the node ``/bot`` with these parameters; ``set`` with ``name`` and ``value`` once one
  is set;
* ``{"do": "get", "node", "names"}``: then ``values`` with ``values``, or ``error``;
* ``{"do": "list", "node"}``: then ``names`` with ``names``;
* ``{"do": "set", "node", "name", "value"}``: then ``result`` with ``ok`` and ``reason``.

Events beside: ``up``; ``done`` after each line.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from typing import Any

import zenoh

from node import say
from rmpa.gateway.ros2.params import SERVICES, ParamTypes
from rmpa.gateway.ros2.types import Ros2Types

TYPES = ParamTypes(Ros2Types("jazzy"))
_kept: list[Any] = []


def _key(node: str, service: str) -> str:
    kind, type_hash = TYPES.service(service)
    return f"0/{node.strip('/')}/{service}/rcl_interfaces::srv::dds_::{kind.rpartition('/')[2]}_/{type_hash}"


def _serve(session: zenoh.Session, values: dict[str, Any]) -> None:
    lead = f"@ros2_lv/0/{session.info.zid()}/0"
    _kept.append(session.liveliness().declare_token(f"{lead}/0/NN/%/%/bot"))
    for number, service in enumerate(("get_parameters", "list_parameters", "set_parameters"), 1):
        key = _key("/bot", service)
        kind, type_hash = key.split("/")[-2:]
        _kept.append(session.declare_queryable(key, _taker(service, values), complete=True))
        token = f"{lead}/{number}/SS/%/%/bot/%bot%{service}/{kind}/{type_hash}/::,10:,:,:,,"
        _kept.append(session.liveliness().declare_token(token))


def _taker(service: str, values: dict[str, Any]) -> Any:
    kind = TYPES.service(service)[0]

    def take(query: zenoh.Query) -> None:
        request = TYPES.read(f"{kind}_Request", query.payload.to_bytes())
        fields: dict[str, Any]
        if service == "list_parameters":
            names = TYPES.make("rcl_interfaces/msg/ListParametersResult", names=list(values), prefixes=[])
            fields = {"result": names}
        elif service == "get_parameters":
            fields = {"values": [TYPES.value(values.get(name)) for name in request.names]}
        else:
            fields = {"results": []}
            for each in request.parameters:
                values[each.name] = TYPES.plain(each.value)
                say("set", name=each.name, value=values[each.name])
                fields["results"].append(
                    TYPES.make("rcl_interfaces/msg/SetParametersResult", successful=True, reason="")
                )
        query.reply(query.key_expr, TYPES.write(f"{kind}_Response", **fields), attachment=query.attachment)

    return take


def _call(session: zenoh.Session, node: str, service: str, **fields: Any) -> Any:
    kind = TYPES.service(service)[0]
    attachment = struct.pack("<qqB16s", 1, time.time_ns(), 16, b"p" * 16)
    request = TYPES.write(f"{kind}_Request", **fields)
    for reply in session.get(
        _key(node, service), payload=request, attachment=attachment, timeout=10, target=zenoh.QueryTarget.ALL_COMPLETE
    ):
        if reply.ok is not None:
            return TYPES.read(f"{kind}_Response", reply.ok.payload.to_bytes())
    return None


def _do(session: zenoh.Session, told: dict[str, Any]) -> None:
    match told["do"]:
        case "serve":
            _serve(session, told["values"])
        case "get":
            answer = _call(session, told["node"], "get_parameters", names=told["names"])
            say("values", values=None if answer is None else [TYPES.plain(each) for each in answer.values])
        case "list":
            answer = _call(session, told["node"], "list_parameters", prefixes=[], depth=0)
            say("names", names=None if answer is None else [str(each) for each in answer.result.names])
        case "set":
            value = TYPES.value(told["value"])
            wanted = [TYPES.make("rcl_interfaces/msg/Parameter", name=told["name"], value=value)]
            answer = _call(session, told["node"], "set_parameters", parameters=wanted)
            result = None if answer is None else answer.results[0]
            say(
                "result", ok=result is not None and bool(result.successful), reason=str(getattr(result, "reason", ""))
            )


def main() -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
    session = zenoh.open(config)
    say("up", services=list(SERVICES))
    for line in sys.stdin:
        told = json.loads(line)
        _do(session, told)
        say("done", do=told["do"])
    session.close()


if __name__ == "__main__":
    main()
