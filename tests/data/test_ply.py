from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrgs.data.ply import read_ply
from mrgs.errors import SceneError

FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">"}
COLOURED = "property float x\nproperty float y\nproperty double z\n" + "".join(
    f"property uchar {name}\n" for name in ("red", "green", "blue")
)


def header(form: str, count: object, properties: str = COLOURED, before: str = "") -> bytes:
    return (
        f"ply\nformat {form} 1.0\ncomment hello\n{before}element vertex "
        f"{count}\n{properties}end_header\n"
    ).encode()


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(0, 5), st.just(3)),
        elements=st.floats(-1e6, 1e6, width=32),
    )
)
def test_all_formats_read_the_same(tmp_path_factory, positions):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    rows = [tuple(row.tolist()) for row in positions]
    bodies = {
        form: b"".join(struct.pack(order + "ffd3B", *row, 255, 0, 51) for row in rows)
        for form, order in FORMATS.items()
    }
    bodies["ascii"] = "".join(f"{x!r} {y!r} {z!r} 255 0 51\n" for x, y, z in rows).encode()
    for form, body in bodies.items():
        path.write_bytes(header(form, len(rows)) + body)
        got, colors = read_ply(path)
        np.testing.assert_array_equal(got, positions.reshape(-1, 3))
        np.testing.assert_allclose(colors, np.tile([1, 0, 0.2], (len(rows), 1)))


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_elements_before_the_vertices_are_skipped(tmp_path, form):
    before = "element camera 2\nproperty int a\nproperty short b\n"
    properties = "property float x\nproperty float y\nproperty float z\n"
    body = b"1 2 3 4\n5 6 7\n" if form == "ascii" else struct.pack(">ihih3f", 1, 2, 3, 4, 5, 6, 7)
    (tmp_path / "a.ply").write_bytes(header(form, 1, properties, before) + body)
    positions, colors = read_ply(tmp_path / "a.ply")
    assert positions.tolist() == [[5, 6, 7]]
    assert colors is None


def test_what_follows_the_vertices_is_ignored(tmp_path):
    head = header("ascii", 1).replace(
        b"end_header", b"element face 1\nproperty list uchar int v\nend_header"
    )
    (tmp_path / "a.ply").write_bytes(head.replace(b"\n", b"\r\n") + b"1 2 3 0 0 0\r\n3 0 0 0\r\n")
    assert read_ply(tmp_path / "a.ply")[0].tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(("kind", "value"), [("float", 0.2), ("ushort", 13107), ("uchar", 51)])
def test_colours_are_scaled_by_their_type(tmp_path, kind, value):
    properties = COLOURED.replace("uchar", kind)
    (tmp_path / "a.ply").write_bytes(header("ascii", 1, properties) + f"0 0 0 {value} 0 0".encode())
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply")[1], [[0.2, 0, 0]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "PLY file"),
        (b"plyable text", "PLY file"),
        (b"ply\n" + b"comment x\n" * 10_000 + b"end_header\n", "PLY file"),
        (header("ascii", 1).replace(b"format ascii 1.0\n", b""), "'property float x'"),
        (b"ply\nend_header\n", "no format line"),
        (header("binary", 1), "'format binary 1.0'"),
        (header("ascii", -1), "'element vertex -1'"),
        (header("ascii", "²"), "header line"),
        (header("ascii", 1, "property quad x\n"), "'property quad x'"),
        (header("ascii", 1, "property float x\n" * 2), "'property float x'"),
        (header("ascii", 1, "property float x\n"), "x, y and z"),
        (
            header("ascii", 1, COLOURED + "property list uchar int v\n") + b"0 0 0 0 0 0 1 0",
            "has lists",
        ),
        (header("ascii", 1).replace(b"vertex", b"point"), "no element vertex"),
        (header("ascii", 2) + b"1 2 3 4 5 6\n", "2 vertices"),
        (header("ascii", 1) + b"1.5555 2.5555 3", "1 vertices"),
        (header("ascii", 999_999_999_999_999) + b"1 2 3 4 5 6\n", "shorter than"),
        (header("binary_little_endian", 999_999_999_999_999) + b"1234", "shorter than"),
        (header("ascii", 1) + b"1 2 x 4 5 6\n", "not a number"),
    ],
)
def test_damaged_files(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(SceneError, match=message) as caught:
        read_ply(tmp_path / "a.ply")
    assert str(caught.value).startswith(str(tmp_path / "a.ply"))
