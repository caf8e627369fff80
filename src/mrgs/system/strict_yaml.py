"""Dataclasses as YAML and back, strictly: no misspelt field is ignored; and ranges of values."""

from __future__ import annotations

import dataclasses
import datetime
import operator
import sys
import types
import typing
from collections.abc import Iterable, Mapping
from contextlib import suppress
from copy import deepcopy
from functools import lru_cache
from typing import Any, Literal, SupportsIndex, TypeVar, cast, get_args

import yaml

from mrgs.errors import ConfigError
from mrgs.system.wording import shown

Config = TypeVar("Config")

LONGEST_TEXT = 100_000
"""Characters; a configuration has some thousands, a survey full of quotes 80,000."""

DEEPEST = 20
"""Levels of lists and mappings; a configuration has four."""


def write_yaml(config: Any) -> str:
    """A dataclass as YAML, every field written out."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The entries of nested mappings, as of ``dataclasses.asdict``, by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def read_yaml(cls: type[Config], text: str, source: str, base: Config | None = None) -> Config:
    """The dataclass that ``write_yaml`` wrote, or a part of one over another of the same kind, the
    ``base``; ``source`` is the file's name, for messages. ConfigError if it is not YAML, or has a
    field that does not exist, or a value of the wrong type."""
    values = parse_yaml(text, source)
    if base is not None:
        values = _over(dataclasses.asdict(typing.cast(Any, base)), values)
    return _build(cls, values, source)


def parse_yaml(text: str, source: str) -> Any:
    """Parse YAML with plain values only. ConfigError if it is not YAML, has a key twice in a
    mapping, an alias or a merge, or is longer than ``LONGEST_TEXT``."""
    if len(text) > LONGEST_TEXT:
        raise ConfigError(f"{source} has more than {LONGEST_TEXT:,} characters")
    try:
        return deepcopy(_parsed(text))
    # PyYAML raises almost anything of what is not of its tag's type, such as !!int without a value.
    except (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError,
            TypeError, ValueError) as error:  # fmt: skip
        reason = str(error).partition("\n")[0][:200] or type(error).__name__
        raise ConfigError(f"{source} is not valid YAML: {reason}") from error


@lru_cache(maxsize=4)
def _parsed(text: str) -> Any:
    """What YAML says; to open a run reads its configuration several times."""
    return _StrictLoader(text).get_single_data()


class _StrictLoader(yaml.SafeLoader):
    """Refuses duplicate keys of a mapping, of which others take the last, and what makes a short
    text a large value, or a slow one: aliases, merges and deep lists."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name); write out what it stands for")
        if self.depth > DEEPEST:
            raise yaml.YAMLError(f"it has lists or mappings more than {DEEPEST} deep")
        self.depth += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        if any(key.value == "<<" for key, _ in node.value):
            raise yaml.YAMLError("it merges mappings (<<); write out what it merges")

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.YAMLError("a key is not a plain value")
            if (key.tag, key.value) in seen:
                raise yaml.YAMLError(f"duplicate key {shown(key.value)}")
            seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


def _over(base: Any, values: Any) -> Any:
    """Nested dictionaries, ``values`` where they have an entry and ``base`` elsewhere; where they
    name another member of a union, nothing of ``base``."""
    if not isinstance(base, dict) or not isinstance(values, dict):
        return values
    if "name" in base and values.get("name", base["name"]) != base["name"]:
        return values
    return {**base, **{name: _over(base.get(name), value) for name, value in values.items()}}


def _build(cls: type[Config], values: Any, source: str) -> Config:
    """A dataclass from nested dictionaries."""
    if not isinstance(values, dict):
        raise ConfigError(f"{source} must hold the fields of a configuration")
    hints = typing.get_type_hints(cls)
    if unknown := [name for name in values if name not in hints]:
        raise ConfigError(
            f"{source}: there is no field {shown(unknown[0])}; known are {', '.join(hints)}"
        )
    fields = {
        name: convert(hints[name], value, f"{source}: {name}") for name, value in values.items()
    }
    try:
        return cls(**fields)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


def _member(options: list[Any], value: Any) -> Any:
    """The member of a union that the value names: members have a field ``name: Literal[...]``. The
    first where it names none of them."""
    name = value.get("name") if isinstance(value, dict) else None
    named = (
        option for option in options[1:] if name in get_args(typing.get_type_hints(option)["name"])
    )
    return next(named, options[0])


def convert(hint: Any, value: Any, source: str) -> Any:
    """A value of YAML as its field's type; nested dataclasses are built. ConfigError, which names
    the ``source``, if it is of another type."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        if value is None:
            return None
        hint = _member([option for option in get_args(hint) if option is not type(None)], value)
    if typing.get_origin(hint) is tuple:
        kinds, length = get_args(hint), f" of {len(get_args(hint))} values"
        if kinds[-1] is Ellipsis:
            kinds, length = kinds[:1] * (len(value) if isinstance(value, list) else 0), ""
        if not isinstance(value, list) or len(value) != len(kinds):
            raise ConfigError(f"{source} must be a list{length}, not {shown(value)}")
        return tuple(convert(*each, source) for each in zip(kinds, value, strict=True))
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, source)
    if typing.get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise ConfigError(
                f"{source} must be one of {', '.join(get_args(hint))}, not {shown(value)}"
            )
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not -sys.float_info.max <= value <= sys.float_info.max:
            raise ConfigError(f"{source} must be a finite number, not {shown(value)}")
        return float(value)
    if hint is datetime.date:
        return _day(value, source)
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        # YAML takes 10:30 for a number.
        quotes = "; put it in quotes" if hint is str else ""
        raise ConfigError(f"{source} must be of type {hint.__name__}, not {shown(value)}{quotes}")
    return value


def _day(value: Any, source: str) -> datetime.date:
    """A day, as YAML reads it or as a text in quotes."""
    if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
        return value
    try:
        return datetime.date.fromisoformat(value)
    except (TypeError, ValueError):
        raise ConfigError(
            f"{source} must be a day such as 2026-05-01, without a time, not "
            f"{shown(value if isinstance(value, int) else str(value))}"
        ) from None


MOST_STEPS = 10**9
MOST_WIDTH = 4_096
"""Largest width of a hidden layer."""

MOST_WEIGHT = 10**12
"""Largest weight of a loss, or of anything else that multiplies."""

MOST_RATE = 10
"""Largest learning rate."""

MOST_SEED = 2**32 - 1


def require_within(
    config: Any, names: Iterable[str], low: float, high: float, title: str = "{}"
) -> None:
    """Fields of a configuration must be from ``low`` to ``high``, and not NaN; ``title`` is what
    the message calls a field, with {} for its name. ConfigError if a value is outside."""
    for name in names:
        value = getattr(config, name)
        limit = f"at least {low:,}" if not low <= value else f"at most {high:,}"
        if not low <= value <= high:
            raise ConfigError(f"{title.format(name)} must be {limit}, not {shown(value)}")


def whole_number(value: object, name: str) -> int:
    """A whole number of any type, which the message calls by a name. ConfigError if it is not, or
    has more than 128 bits."""
    with suppress(TypeError):
        number = operator.index(cast(SupportsIndex, value))
        if abs(number) < 2**128:
            return number
    raise ConfigError(f"{name} must be a whole number, not {shown(value)}", options=(name,))
