"""``python -m mrgs``: the command line."""

import sys

from mrgs.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
