"""The program ``mrgs``: the command line in a process of its own, which handles interrupts and the
standard streams before it loads anything that takes long."""

import signal
import sys

from mrgs.app.interrupts import guard_streams, interrupts


def main() -> int:
    """Run a command; returns the exit status, see ``mrgs.app.cli.main``."""
    guard_streams(interrupts.output_lost)
    with interrupts:
        from mrgs.app.cli import main as run

        status = run()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it would break off Python's own end
        return status


if __name__ == "__main__":
    sys.exit(main())
