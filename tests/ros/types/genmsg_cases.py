"""Definitions and messages that are easily read in another way than genmsg and genpy do, with their answers.

Texts like those of public packages. ``interop/test_types.py`` asks the installed genmsg and genpy again.
"""

from __future__ import annotations

from typing import Any, Final

# The md5 sum of each text.
MESSAGES: Final[dict[str, str]] = {
    "string MODE_AUTO=auto\n": "be98d1fb05f494bd09a5be084fea6144",
    "string    MODE_AUTO   = auto\n": "be98d1fb05f494bd09a5be084fea6144",
    "string  A= a # b \nstring   B   =b\nint32    C   =   3   # three\n": "e44e8e5ab63f1016052cca8250c74ee1",
    "  string INDENTED=by blanks\n": "3c51d3afc5c2025b797398e16d1cc481",
    "\tstring INDENTED=by a tab\n": "d514144fe8ed771dbd33c44d5855b9ba",
    "string EMPTY=\nstring EQUALS = a=b=c\n": "8b1803d71bda301d5220e704cf0578b5",
    "byte B=-1\nchar C=65\nbool YES=True\nfloat32 PI = 3.14\n": "6058494fe1e1268456489318d92ed68e",
    "int32[0] none\nint32[] any\nint32[3] three\n": "0d85d64d476b79de4d5903024eb64be2",
    "byte[] many\nbyte[2] two\nchar[] text\nduration[1] one\ntime[] times\n": "72ff7fd5213f585760069728a4edda1f",
    "int8 a\r\nstring S = b \r\n": "e2314e146ac0819ddd14813fb2e0d5c9",
}

# The md5 sum, and the full texts of request and response; three empty ones for a text that genmsg refuses.
SERVICES: Final[dict[str, tuple[str, str, str]]] = {
    "int64 a\n---\nint64 b\n": ("f16097f93022db785b2cc9436c158893", "int64 a\n", "int64 b\n\n"),
    "int64 a\n----\nint64 b\n": ("f16097f93022db785b2cc9436c158893", "int64 a\n", "int64 b\n\n"),
    "int64 a\n-----\nint64 b": ("f16097f93022db785b2cc9436c158893", "int64 a\n", "int64 b\n"),
    "int64 a\n--- # the answer\nint64 b\n": ("f16097f93022db785b2cc9436c158893", "int64 a\n", "int64 b\n\n"),
    "---\n": ("d41d8cd98f00b204e9800998ecf8427e", "", "\n"),
    "---": ("d41d8cd98f00b204e9800998ecf8427e", "", ""),
    "int64 a\n\n---\n\n# none\n": ("019706110004b728d56d8baaa8e32797", "int64 a\n\n", "\n# none\n\n"),
    "int64 a\n---\nint64 b\n---\nint64 c\n": (
        "e9a1f77cfc139471e2f84c8720116168", "int64 a\n", "int64 b\nint64 c\n\n",
    ),
    "int64 a\n": ("019706110004b728d56d8baaa8e32797", "int64 a\n\n", ""),
    "int64 a\n ---\n": ("", "", ""),
}  # fmt: skip

VALUES_OF: Final = (
    "byte small\nbyte[] many\nbyte[2] two\nchar letter\nint32[0] none\ntime at\ntime[] times\nduration took\n"
    "float64 real\nfloat32 short\nbool yes\n"
)
# Values of a message of the type above, and its bytes in hex; none for values that are refused.
VALUES: Final[tuple[tuple[dict[str, Any], str], ...]] = (
    ({}, "0000000000000000000000000000000000000000000000000000000000000000000000000000000000"),
    (
        {"small": -1, "many": [-128, 127], "two": [1, -1], "letter": 255},
        "ff02000000807f01ffff000000000000000000000000000000000000000000000000000000000000000000",
    ),
    (
        {"at": {"secs": 4294967295, "nsecs": 999999999}, "times": [{"secs": 2147483648, "nsecs": 1}]},
        "0000000000000000ffffffffffc99a3b010000000000008001000000000000000000000000000000000000000000000000",
    ),
    (
        {"took": {"secs": -2147483648, "nsecs": 0}},
        "0000000000000000000000000000000000000000000000800000000000000000000000000000000000",
    ),
    (
        {"real": -0.0, "short": -0.0, "yes": True},
        "0000000000000000000000000000000000000000000000000000000000000000000000800000008001",
    ),
    # Values that genpy does not write.
    ({"small": 200}, ""),
    ({"small": -129}, ""),
    ({"many": [200]}, ""),
    ({"letter": -1}, ""),
    ({"short": 1e39}, ""),
    ({"at": {"secs": 4294967296, "nsecs": 0}}, ""),
    ({"took": {"secs": 2147483648, "nsecs": 0}}, ""),
)
