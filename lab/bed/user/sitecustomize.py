"""In PYTHONPATH of programs that share this machine's user: each has a home directory of its own.

What a program finds by the password database, as ``rmpa`` does where no variable may lead it, is the directory of
TEST_HOME, else of XDG_STATE_HOME or HOME.
"""

import os
import pwd
from typing import Any


def apply() -> None:
    """Have the password database name that directory for this user."""
    real = pwd.getpwuid

    def getpwuid(user: int) -> Any:
        environ = os.environ
        home = environ.get("TEST_HOME") or environ.get("XDG_STATE_HOME") or environ.get("HOME")
        found = list(real(user))
        return pwd.struct_passwd([*found[:5], home or found[5], found[6]] if user == os.geteuid() else found)

    pwd.getpwuid = getpwuid


apply()
