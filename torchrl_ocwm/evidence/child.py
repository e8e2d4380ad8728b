"""A module as a program in a process that ends cleanly when the one that started it has ended, however that was.

    python child.py MODULE ARGUMENTS...

The standard input is a pipe whose other end nobody else holds. It is run by its path, as importing its package would
cost each process a second.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
from threading import Thread


def main() -> None:
    """Run the module."""
    Thread(target=_end_with_parent, daemon=True).start()
    del sys.path[0]  # the folder of this file, whose names are those of other modules too
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


def _end_with_parent() -> None:
    os.read(0, 1)  # gives nothing, when the other end is closed
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
