"""PLY files: points are read from ASCII or binary of either byte order; any rows are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from mrgs.data.files import read_bytes
from mrgs.errors import SceneError, scene_error
from mrgs.system.atomic import replacing
from mrgs.system.memory import row_chunks
from mrgs.system.wording import shown

MAX_HEADER_BYTES = 64 * 1024

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLOR_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)

_BRIGHTEST_FLOAT = 2.0
"""Colours in floats span 0 to 1, and may be a little more; where one is larger, 0 to 255."""


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]
    has_lists: bool = False

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(list(self.properties.items()))


Columns: TypeAlias = Mapping[str, np.ndarray]
"""Scalar properties by name, of equal length."""


def write_ply(
    path: Path, elements: Mapping[str, Columns | np.ndarray], comments: Sequence[str] = ()
) -> Path:
    """Write a binary PLY file; returns the path. RunError if it cannot be written.

    Args:
        elements: by name: columns, or a plain [N, K] array of integers, which is written as lists
            of K ``vertex_indices`` of 32 bits.
        comments: lines for the header; what is not ASCII is written as degrees Celsius or ?.
    """
    header = ["ply", "format binary_little_endian 1.0"]
    for line in comments:
        text = " ".join(line.split()).replace("°C", "degrees Celsius")
        header.append(f"comment {text.encode('ascii', 'replace').decode('ascii')}")
    for name, element in elements.items():
        header.append(f"element {name} {_count(element)}")
        if isinstance(element, np.ndarray):
            header.append("property list uchar int vertex_indices")
        else:
            kinds = {column: _PLY_TYPES[values.dtype.str[1:]] for column, values in element.items()}
            header += [f"property {kind} {column}" for column, kind in kinds.items()]
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for element in elements.values():
            for rows in row_chunks(_count(element)):
                file.write(_records(element, rows).view(np.uint8).data)
    return path


def write_points(
    path: Path, positions: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]
) -> Path:
    """Write coloured points as a binary PLY file, positions as float32; returns the path. RunError
    if the file cannot be written."""
    columns = {axis: positions[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {name: colors[:, i] for i, name in enumerate(_COLOR_NAMES[0])}
    return write_ply(path, {"vertex": columns})


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Positions [N, 3] as they stand in the file, and colours [N, 3] in [0, 1] (None if it has
    none). Memory is bounded by the file's size. SceneError if it is not a PLY file with vertices x,
    y, z, or shorter than its header says."""
    data = read_bytes(path)
    end = data.find(b"\nend_header", 0, MAX_HEADER_BYTES) + 1
    newline = data.find(b"\n", end, end + 16) if end > 0 else -1
    if not data.startswith(b"ply") or newline < 0:
        raise scene_error(path, "is not a PLY file (no header found); export the points again")
    lines = data[:end].decode("latin-1").splitlines()[1:]
    ascii_text, elements = _parse_header(lines, path)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise scene_error(path, "has no element vertex; export it as a point cloud")
    before, element = elements[: names.index("vertex")], elements[names.index("vertex")]
    if element.has_lists or any(other.has_lists for other in before):
        raise scene_error(path, "has lists in or before its vertices; export it as a point cloud")
    if not {"x", "y", "z"} <= set(element.properties):
        raise scene_error(path, "has vertices without x, y and z; export it as a point cloud")
    body = data[newline + 1 :]
    if ascii_text:
        vertices = _ascii_vertices(body, element, before, path)
    else:
        offset = sum(other.count * other.dtype.itemsize for other in before)
        if offset + element.count * element.dtype.itemsize > len(body):
            raise _too_short(path, element.count)
        vertices = np.frombuffer(body, element.dtype, element.count, offset)
    positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return positions, _colors(vertices)


def _parse_header(lines: list[str], path: Path) -> tuple[bool, list[_Element]]:
    """Whether the body is text, and the elements in order, with NumPy's type of each property."""
    order: str | None = None
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _BYTE_ORDERS:
                order = name
            case ["element", name, count] if (
                count.isascii() and count.isdigit() and len(count) < 16
            ):
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if (
                order and elements and kind in _TYPES and name not in elements[-1].properties
            ):
                elements[-1].properties[name] = _BYTE_ORDERS[order] + _TYPES[kind]
            case _:
                raise scene_error(
                    path,
                    f"has the header line {shown(line)}, which is not PLY; export the points again",
                )
    if order is None:
        raise scene_error(path, "has no format line in its header; export the points again")
    return order == "ascii", elements


def _ascii_vertices(
    body: bytes, vertex: _Element, before: list[_Element], path: Path
) -> np.ndarray:
    skipped = sum(element.count * len(element.properties) for element in before)
    columns = len(vertex.properties)
    wanted = vertex.count * columns
    if 2 * (skipped + wanted) > len(body) + 1:  # a number and a separator each
        raise _too_short(path, vertex.count)
    tokens = body.split(maxsplit=skipped + wanted)[skipped : skipped + wanted]
    try:
        numbers = np.array(tokens, dtype=np.float64)
    except ValueError as error:
        raise scene_error(
            path, f"holds something that is not a number ({error!s:.99}); export the points again"
        ) from None
    if numbers.size < wanted:
        raise _too_short(path, vertex.count)
    table = numbers.reshape(vertex.count, columns)
    vertices = np.empty(vertex.count, dtype=vertex.dtype)
    with np.errstate(all="ignore"):
        for column, name in enumerate(vertex.properties):
            vertices[name] = table[:, column]
    return vertices


def _too_short(path: Path, count: int) -> SceneError:
    return scene_error(
        path,
        f"is shorter than the {count} vertices that its header promises; export the points again",
    )


def _colors(vertices: np.ndarray) -> NDArray[np.float64] | None:
    available = {name.lower(): name for name in vertices.dtype.names or ()}
    names = next((names for names in _COLOR_NAMES if set(names) <= set(available)), None)
    if names is None:
        return None
    colors = np.stack([vertices[available[name]] for name in names], axis=1).astype(np.float64)
    brightest = float(np.max(colors, where=np.isfinite(colors), initial=0.0))
    if vertices.dtype[available[names[0]]].kind != "f" or brightest > _BRIGHTEST_FLOAT:
        colors /= 65535 if brightest > 255 else 255
    return np.clip(np.nan_to_num(colors, nan=0.5), 0.0, 1.0)


def _count(element: Columns | np.ndarray) -> int:
    return len(element) if isinstance(element, np.ndarray) else len(next(iter(element.values())))


def _records(element: Columns | np.ndarray, rows: slice) -> np.ndarray:
    """Some rows of an element as they are in the file."""
    columns: Columns
    if isinstance(element, np.ndarray):
        indices = element[rows].astype(np.int32)
        columns = {"count": np.full(len(indices), indices.shape[1], "u1"), "indices": indices}
    else:
        columns = {name: column[rows] for name, column in element.items()}
    kinds = [
        (name, column.dtype.newbyteorder("<"), column.shape[1:]) for name, column in columns.items()
    ]
    records = np.empty(_count(columns), dtype=kinds)
    for name, column in columns.items():
        records[name] = column
    return records
