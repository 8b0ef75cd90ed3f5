"""In place of rmpa for the system's Python, which it is not made for: says what runs a file that needs it."""

import sys

raise (SystemExit if __name__ == "__main__" else ImportError)(
    f"RMPA is for a Python of its own, and this is {sys.executable}: run a file of Smart Resources by "
    "`rmpa run FILE`, another one with /usr/lib/rmpa/python/bin/python3"
)
