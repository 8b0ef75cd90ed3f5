"""The service type of the workers and callers, which no package has; ``work.hpp`` is the same in C++."""

from genpy.dynamic import generate_dynamic

TYPE = "rmpa_test/Work"
MD5 = "af5edcf406bf3ebf7ab094f161a24925"
_REQUEST = "string op\nfloat64 seconds\nuint8[] data\n"
_RESPONSE = "string text\nuint8[] data\n"


class Work:
    """What genpy would make of the ``.srv``."""

    _type = TYPE
    _md5sum = MD5
    _request_class = generate_dynamic(f"{TYPE}Request", _REQUEST)[f"{TYPE}Request"]
    _response_class = generate_dynamic(f"{TYPE}Response", _RESPONSE)[f"{TYPE}Response"]


def of_another_release() -> type:
    """The same name, with another definition and md5 sum."""
    return type("Work", (Work,), {"_md5sum": "f" * 32})
