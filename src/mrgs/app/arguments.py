"""From argv to a command: what is listed without one, and what is said of one that does not
exist."""

from __future__ import annotations

import difflib
import inspect
import re
import sys
from collections.abc import Sequence
from dataclasses import is_dataclass
from functools import reduce
from importlib.metadata import version
from operator import or_
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

import tyro

from mrgs.app.commands import COMMANDS
from mrgs.app.style import say_error, styled
from mrgs.errors import ConfigError, MrgsError

EXIT_USER_ERROR = 2

DESCRIPTION = "One 3D model in colour and in °C from RGB and thermal photos."

_CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


def parse(argv: Sequence[str]) -> Any:
    """The command, one of the types in ``COMMANDS``, with its options.

    Raises:
        SystemExit: with 0 after a help text, a version or a completion script was printed; with 2
            after an error.
    """
    first = argv[0] if argv else "--help"
    if first in ("-h", "--help", "help"):
        print(overview())
        raise SystemExit(0)
    if first == "--version":
        print(f"mrgs {version('mrgs')}")
        raise SystemExit(0)
    if first.startswith(_COMPLETION):
        return tyro.cli(any_command(), prog="mrgs", args=argv, config=_CONFIG)
    if first not in COMMANDS:
        say_error(_unknown(first))
        raise SystemExit(EXIT_USER_ERROR)
    require_numbers(COMMANDS[first], argv[1:])
    return tyro.cli(COMMANDS[first], prog=f"mrgs {first}", args=argv[1:], config=_CONFIG)


def require_numbers(command: type, argv: Sequence[str]) -> None:
    """Check the options that take numbers.

    Raises:
        ConfigError: one has something else.
    """
    kinds = numeric_options(command)
    for place, argument in enumerate(argv):
        flag, equals, value = argument.partition("=")
        numbers = kinds.get(flag, ())
        given = [value, *argv[place + 1 :]] if equals else argv[place + 1 :]
        for kind, text in zip(numbers, given, strict=False):
            if text.startswith("--"):
                break
            _require_number(flag, kind, text)


def _require_number(flag: str, kind: type, text: str) -> None:
    try:
        kind(text)
    except ValueError:
        if text.endswith("%") and kind is float and is_number(text[:-1]):
            raise ConfigError(
                f"{flag} {text}: leave the % out; a share is written as {float(text[:-1]) / 100:g}"
            ) from None
        what = "a whole number" if kind is int else "a number, such as 0.9"
        raise ConfigError(f"{flag} {text}: write {what}") from None


def is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def numeric_options(command: type) -> dict[str, tuple[type, ...]]:
    """The flags of a command that take numbers, with the types of these."""
    found: dict[str, tuple[type, ...]] = {}
    for name, hint in get_type_hints(command).items():
        if is_dataclass(hint):
            found |= numeric_options(cast(type, hint))
            continue
        (kind, *more) = [each for each in get_args(hint) if each is not type(None)] or [hint]
        parts = (hint,) if get_origin(hint) is tuple else (kind,)
        if more and get_origin(hint) is not tuple:
            continue  # a choice of types
        types = get_args(parts[0]) if get_origin(parts[0]) is tuple else parts
        if types and all(each in (int, float) for each in types):
            found[f"--{name.replace('_', '-')}"] = types
    return found


def overview() -> str:
    """All commands, one line each."""
    names = "\n".join(
        f"  {styled(f'{name:9}', 'bold', sys.stdout)}{summary_of(command)}"
        for name, command in COMMANDS.items()
    )
    return (
        f"{DESCRIPTION}\n\nusage: mrgs COMMAND [OPTIONS]\n\n{names}\n\n"
        "mrgs COMMAND --help lists the options of a command, mrgs --version prints the version."
    )


def summary_of(command: type) -> str:
    """The first paragraph of a command's help."""
    return (inspect.getdoc(command) or "").partition("\n\n")[0].replace("\n", " ")


def any_command() -> Any:
    """The type of which every command is a subcommand, for shell completion."""
    return reduce(
        or_,
        [
            Annotated[kind, tyro.conf.subcommand(name, description=summary_of(kind))]
            for name, kind in COMMANDS.items()
        ],
    )


def flag_of(parameter: str) -> str:
    """The flag of a parameter of the Python API, whose name may end with a unit:
    ``thermal_fov_deg`` is --thermal-fov."""
    return "--" + re.sub("_(c|m|s|deg)$", "", parameter).replace("_", "-")


def flags_of(error: MrgsError) -> str:
    """The command line's names of the parameters that an error is about, in brackets; empty if
    there are none."""
    flags = [flag_of(option) for option in error.options]
    return f" ({', '.join(flags)})" if flags else ""


def _unknown(name: str) -> str:
    """The message for a command that does not exist."""
    if name.startswith("-"):
        return f"{name} must follow a command; `mrgs` lists them"
    near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]}?" if near else "`mrgs` lists the commands"
    return f"unknown command {name!r}; {hint}"


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
