"""Colours of messages, where there is a terminal that shows them."""

from __future__ import annotations

import sys
from typing import TextIO

from rich.console import Console
from rich.text import Text


def styled(text: str, style: str, stream: TextIO) -> str:
    """The text with the codes of a style such as "bold red"; as it is where the stream is not a
    terminal with colours, or NO_COLOR is set."""
    console = Console(file=stream, highlight=False, soft_wrap=True)
    if not console.is_terminal or console.no_color:
        return text
    with console.capture() as capture:
        console.print(Text(text, style=style), end="")
    return capture.get()


def say_error(text: str) -> None:
    """Print an error, on one line."""
    print(f"{styled('mrgs: error:', 'bold red', sys.stderr)} {text}", file=sys.stderr)


def say_warning(text: str) -> None:
    """Print what the user should judge, on one line."""
    print(f"{styled('mrgs: warning:', 'yellow', sys.stderr)} {text}", file=sys.stderr)


def say_note(text: str) -> None:
    """Print what the user should know, on one line."""
    print(f"{styled('mrgs: note:', 'yellow', sys.stderr)} {text}", file=sys.stderr)
