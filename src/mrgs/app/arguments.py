"""The command line's arguments: parsing, the list of commands, names of options in messages."""

from __future__ import annotations

import difflib
import inspect
import re
import sys
from collections.abc import Sequence
from functools import reduce
from importlib.metadata import version
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from mrgs.app.commands import COMMANDS
from mrgs.app.terminal import print_error, styled
from mrgs.errors import ConfigError, MrgsError

EXIT_USER_ERROR = 2

_CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


def parse(argv: Sequence[str]) -> Any:
    """The command, one of the types in ``COMMANDS``, with its options.

    Raises:
        SystemExit: with 0 after a help text, a version or a completion script was printed; with 2
            after an error.
    """
    first = argv[0] if argv else "--help"
    if first in COMMANDS:
        return tyro.cli(COMMANDS[first], prog=f"mrgs {first}", args=argv[1:], config=_CONFIG)
    if first.startswith(_COMPLETION):
        kinds = [
            Annotated[kind, tyro.conf.subcommand(name, description=_summary(kind))]
            for name, kind in COMMANDS.items()
        ]
        any_of_them: Any = reduce(or_, kinds)
        return tyro.cli(any_of_them, prog="mrgs", args=argv, config=_CONFIG)
    if first in ("-h", "--help", "help"):
        print(_overview())
        raise SystemExit(0)
    if first == "--version":
        print(f"mrgs {version('mrgs')}")
        raise SystemExit(0)
    near = difflib.get_close_matches(first, COMMANDS, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]}?" if near else "`mrgs` lists the commands"
    is_option = first.startswith("-")
    print_error(
        f"{first} must follow a command; `mrgs` lists them"
        if is_option
        else f"unknown command {first!r}; {hint}"
    )
    raise SystemExit(EXIT_USER_ERROR)


def _overview() -> str:
    """All commands, one line each."""
    names = "\n".join(
        f"  {styled(f'{name:9}', 'bold', sys.stdout)}{_summary(command)}"
        for name, command in COMMANDS.items()
    )
    return (
        f"One 3D model in colour and in °C from RGB and thermal photos.\n\n"
        f"usage: mrgs COMMAND [OPTIONS]\n\n{names}\n\n"
        f"mrgs COMMAND --help lists the options of a command, mrgs --version prints the version."
    )


def _summary(command: type) -> str:
    """The first paragraph of a command's help."""
    return (inspect.getdoc(command) or "").partition("\n\n")[0].replace("\n", " ")


def flag_of(parameter: str) -> str:
    """The flag of a parameter of the Python API, whose name may end with a unit:
    ``thermal_fov_deg`` is --thermal-fov."""
    return "--" + re.sub("_(c|m|s|deg)$", "", parameter).replace("_", "-")


def flags_of(error: MrgsError) -> str:
    """The flags of the parameters that an error is about, in brackets; empty if there are none."""
    flags = [flag_of(option) for option in error.options]
    return f" ({', '.join(flags)})" if flags else ""


def read_text(path: Path) -> str:
    """The text of a file that an option names.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: cannot be read as text ({getattr(error, 'strerror', 'not UTF-8')})"
        ) from error
