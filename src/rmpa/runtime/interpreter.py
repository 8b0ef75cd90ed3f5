"""This Python and the variables of another one: PYTHONPATH and the like, which ``setup.bash`` of ROS sets.

They find message definitions (``ros.types.installed``) and go on to programs of the user; rmpa's own modules do not
come from there. The bundle's ``rmpa`` starts its Python isolated (``-I``); a script that pip wrote does not, so there
what PYTHONPATH names is only searched last.
"""

import os
import sys


def own_command(*words: str) -> list[str]:
    """The command line of another program of rmpa, by this Python, as deaf to the environment as this process is.

    Without ``-I`` it is at least deaf to the working directory (``-P``), which ``-m`` else searches first.
    """
    return [sys.executable, "-I" if sys.flags.isolated else "-P", "-m", "rmpa", *words]


def search_python_path_last() -> None:
    """Import modules of this Python before those of PYTHONPATH, which may be another Python's; the variable stays."""
    if not sys.flags.ignore_environment and (value := os.environ.get("PYTHONPATH")):
        named = {os.path.abspath(folder) for folder in value.split(os.pathsep)}  # noqa: PTH100 - pathlib takes 5 ms
        sys.path.sort(key=named.__contains__)
