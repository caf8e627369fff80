"""Records from JSON, each value checked against its field's type."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import msgspec

from mrgs.errors import scene_error
from mrgs.system.wording import shown

Record = TypeVar("Record")

Finite: TypeAlias = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""A number that is neither NaN nor infinite."""

NotNegative: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=sys.float_info.max)]
"""A finite number of at least 0."""

Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0)]


def from_json(kind: type[Record], value: object) -> Record:
    """A dataclass or a named tuple from parsed JSON; entries that it has no field for are ignored.
    ValueError if a field is missing or of another type; the message begins with its path."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        where = path.strip("`").removeprefix(".")
        raise ValueError(f"{where}: {problem}" if where else problem) from None


def json_value(
    kind: Any, value: object, name: str, file: Path | str, remedy: str = "correct it"
) -> Any:
    """A value of a JSON file as a type, see ``from_json``; SceneError, with its name, if not."""
    try:
        return from_json(kind, value)
    except ValueError as error:
        raise scene_error(file, f"{name} is {shown(value)} ({error}); {remedy}") from None
