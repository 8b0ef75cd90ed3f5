#!/usr/bin/python3
"""Writes what genmsg and genpy make of texts and values on the standard input, and of all installed types (JSON)."""

import importlib
import io
import json
import pathlib
import sys

import genmsg  # type: ignore[import-not-found] # of Debian's Python
import genpy.dynamic
import genpy.message


def message(text: str) -> str:
    context = genmsg.MsgContext.create_default()
    sum_: str = genmsg.compute_md5(context, genmsg.msg_loader.load_msg_from_string(context, text, "my_msgs/Case"))
    return sum_


def service(text: str) -> "tuple[str, str, str]":
    context = genmsg.MsgContext.create_default()
    try:
        spec = genmsg.msg_loader.load_srv_from_string(context, text, "my_msgs/Case")
    except genmsg.InvalidMsgSpec:
        return "", "", ""
    genmsg.load_depends(context, spec, {})
    halves = (genmsg.compute_full_text(context, half) for half in (spec.request, spec.response))
    return (genmsg.compute_md5(context, spec), *halves)


def serialized(kind: type, values: "dict[str, object]") -> str:
    made, out = kind(), io.BytesIO()
    try:
        genpy.message.fill_message_args(made, [values])
        made.serialize(out)
    except (genpy.SerializationError, genpy.MessageException, ValueError, TypeError, OverflowError):
        return ""
    return out.getvalue().hex()


def installed() -> "dict[str, tuple[str, str]]":
    """Md5 sum and full text of each message, request and response; the sum alone of each service."""
    found = {}
    for folder in map(pathlib.Path, sys.path):
        for file in (*folder.glob("*/msg/__init__.py"), *folder.glob("*/srv/__init__.py")):
            for each in vars(importlib.import_module(f"{file.parts[-3]}.{file.parts[-2]}")).values():
                if hasattr(each, "_type") and hasattr(each, "_md5sum"):
                    found[each._type] = each._md5sum, getattr(each, "_full_text", "")
    return found


asked = json.load(sys.stdin)
kind = genpy.dynamic.generate_dynamic("my_msgs/Case", asked["values_of"])["my_msgs/Case"]
answers = {
    "messages": {text: message(text) for text in asked["messages"]},
    "services": {text: service(text) for text in asked["services"]},
    "values": [serialized(kind, values) for values in asked["values"]],
    "installed": installed(),
}
json.dump(answers, sys.stdout)
