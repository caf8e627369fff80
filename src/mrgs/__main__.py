"""The program ``mrgs``: the command line in a process of its own.

It handles interrupts and the standard streams before it loads anything that takes long.
"""

import sys

from mrgs.app.interrupts import interrupts
from mrgs.app.streams import guard_streams, open_missing_streams


def main() -> int:
    """Run a command; returns the exit status, see ``mrgs.app.cli.main``."""
    open_missing_streams()
    guard_streams(interrupts.output_lost)
    with interrupts:
        from mrgs.app.cli import main as run

        status = run()
        interrupts.command_is_done()
        return status


if __name__ == "__main__":
    sys.exit(main())
