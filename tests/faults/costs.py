"""The costliest files of every format that a stranger may send, and what reads them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import PIL
import torch

from mrgs.blocks.plan import read_plan
from mrgs.data.colmap import ColmapModel, find_model, read_colmap, read_images, read_points3d
from mrgs.data.images import decode
from mrgs.data.kept import Digests
from mrgs.data.load import read_bounds
from mrgs.data.nerfstudio import read_transforms
from mrgs.data.ply import read_ply
from mrgs.data.radiometric import read_thermal_photo
from mrgs.data.sources import ReadingNotes
from mrgs.marks.store import CameraSpread, MarkStore
from mrgs.prepare.convert import read_rgb
from mrgs.prepare.pairs.find import by_table
from mrgs.prepare.pairs.inventory import take_inventory
from mrgs.prepare.thermal_camera import read_thermal_camera
from mrgs.run_files import checkpoint
from mrgs.run_files.folder import RunFolder
from mrgs.survey import read_survey
from tests.helpers.flir import FlirPhoto, jpg, png

Read = Callable[[Path], object]

WIDE = 4992
"""Pixels across of an image that is as large as one of few bytes may be."""


class Case(NamedTuple):
    """What makes a file, or a folder of files, of about so many bytes, and what reads it."""

    make: Callable[[Path, int], Path]
    read: Read


def text_cases() -> Mapping[str, Case]:
    """Files that grow with what is in them, by their titles."""
    return {
        **dict(_tables()),
        **dict(_pairs()),
        **dict(_json()),
        **dict(_frames()),
        **dict(_colmap()),
        **dict(_ply()),
        **dict(_small_parts()),
        "checkpoint of empty tensors": Case(_checkpoint, checkpoint.read),
    }


def whole_cases() -> Mapping[str, Case]:
    """What may cost as much as a megabyte: a large image in few bytes, a text of YAML, which has a
    greatest length, and folders of many small photos."""
    return {
        **dict(_yaml()),
        **dict(_images()),
        "photos of COLMAP in another folder": Case(_moved_photos, _read_colmap),
        "pairs in other letters": Case(_renamed_pairs, _read_pairs),
    }


def _text(name: str, line: str, head: str = "", tail: str = "") -> Callable[[Path, int], Path]:
    """A line, or what stands in it for its number, as often as it has room."""

    def make(folder: Path, size: int) -> Path:
        count = (size - len(head) - len(tail)) // len(line.encode())
        lines = "".join(line.replace("@", str(n)) for n in range(count)) if "@" in line else ""
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(head + (lines or line * count) + tail, encoding="utf-8")
        return path

    return make


def _tables() -> Iterator[tuple[str, Case]]:
    table = "\n" + 4 * "20.5;21.0;22.5\n"
    lines = {
        "blanks behind a digit": ("a1", " "), "blanks behind a word": ("temp(", " "),
        "degrees": ("", "1 ° "), "quotes": ("", "\"'"), "commas": ("", "1,"), "columns": ("", "1 "),
        "lines of one": ("", "1\n"), "lines of two": ("", "1,1\n"), "digits": ("", "1"),
        "brackets": ("", "[ "), "units": ("", "unit 0.1 "), "letters that unfold": ("", "\ufdfa"),
        "decimals": ("", "a,1,5,1,5,1,5\n"), "empty lines": ("", "\n"),
        "places": ("x;y;t\n", "@;@;2\n"),
    }  # fmt: skip
    for title, (head, line) in lines.items():
        yield f"table of {title}", Case(_text("a.csv", line, head, table), read_thermal_photo)


def _pairs() -> Iterator[tuple[str, Case]]:
    lines = {"commas": ",", "lines": "\n", "words": "a b ", "comments": "# \n", "quotes": '"\n'}
    for title, line in lines.items():
        yield f"pairs of {title}", Case(_text("table/pairs.csv", line), _read_pairs)


def _read_pairs(path: Path) -> object:
    photos = path.parents[1] / "photos"
    if not photos.exists():
        photos.mkdir()
        (photos / "a.png").write_bytes(png(np.zeros((3, 4), np.uint8)))
    return by_table(path, take_inventory(photos))


def _renamed_pairs(folder: Path, _size: int) -> Path:
    photo, count = png(np.zeros((3, 4), np.uint8)), 4_000
    for name in ("rgb", "thermal"):
        (folder / "photos" / name).mkdir(parents=True)
        for number in range(count):
            (folder / f"photos/{name}/{number}A.png").write_bytes(photo)
    return _text("table/pairs.csv", "rgb/@a.png,thermal/@a.png\n")(folder, 25 * count)


def _json() -> Iterator[tuple[str, Case]]:
    texts = {
        "brackets": ("[", "", ""), "keys": ('{"a":', "", ""), "lists": ("[],", "[", "[]]"),
        "digits": ("1", "", ""), "decimals": ("1", "1.", ""),
        "mappings": ('"@":{},', "{", '"a":1}'),
        "frames": ('{"":{}},', '{"frames":[', "{}]}"), "lines": ('{"step":1}\n', "", ""),
        "escapes": ("\\ud83d", '{"a":"', '"}'),
    }  # fmt: skip
    spread = CameraSpread.of(np.arange(12.0).reshape(4, 3))
    readers: Mapping[str, Read] = {
        "transforms.json": lambda path: read_transforms(path.parent.resolve(), path),
        "temperature_bounds.json": lambda path: read_bounds(path.parent, ReadingNotes()),
        "camera.json": read_thermal_camera,
        "marks.json": lambda path: MarkStore(path.parent, spread).read(),
        "blocks.json": read_plan,
        "digests.json": Digests,
        "log.jsonl": lambda path: RunFolder(path.parent).cut_log(1),
    }
    for name, read in readers.items():
        for title, (part, head, tail) in texts.items():
            yield f"{name} of {title}", Case(_text(name, part, head, tail), read)


def _frames() -> Iterator[tuple[str, Case]]:
    pose = '"transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,0]]},'
    frame, size = f'{{"file_path":"a.png",{pose}', '"w":4,"h":3,"fl_x":5,'
    parts = {
        "without a size": (frame, '"fl_x":5,'),
        "with lenses": (f'{{"k1":0.00@,{frame[1:]}', size),
        "with two images": (f'{{"thermal_file_path":"a.png","mask_path":"a.png",{frame[1:]}', size),
    }
    for title, (line, top) in parts.items():
        yield f"frames {title}", Case(partial(_scene, line, top), _read_frames)
    half: Mapping[str, Callable[[int], str]] = {
        "below many keys": _keys,
        "below a list of zeros": lambda many: f'"k5":[{"0," * (many // 2)}0],',
        "below a list that is not read": lambda many: f'"x_fov":[{"0," * (many // 2)}0],',
        "below a large camera": lambda many: f'"thermal_camera":{{{_keys(many)}{size[:-1]}}},',
    }
    for title, top in half.items():

        def make(folder: Path, size_bytes: int, top: Callable[[int], str] = top) -> Path:
            line = f'{{"thermal_file_path":"a.png",{frame[1:]}'
            return _scene(line, size + top(size_bytes // 2), folder, size_bytes)

        yield f"frames {title}", Case(make, _read_frames)


def _keys(size: int) -> str:
    return "".join(f'"{number}":1,' for number in range(size // 10))


def _scene(frame: str, top: str, folder: Path, size: int) -> Path:
    (folder / "a.png").write_bytes(png(np.zeros((3, 4, 3), np.uint8)))
    last = frame.removesuffix(",").replace("@", "0")
    return _text("transforms.json", frame, f'{{{top}"frames":[', f"{last}]}}")(folder, size)


def _read_frames(path: Path) -> object:
    return read_transforms(path.parent.resolve(), path)


def _colmap() -> Iterator[tuple[str, Case]]:
    row = struct.pack("<I7dIxQ", 1, 1, 0, 0, 0, 0, 0, 0, 1, 0)
    texts = {
        "images": ("images", "1 1 0 0 0 0 0 0 1 @\n\n"),
        "cameras": ("cameras", "@ PINHOLE 4 3 5 5 2 1\n"),
        "points": ("points3D", "1 0 0 0 0 0 0\n"),
        "comments": ("images", "#\n"),
        "digits": ("points3D", "1"),
    }
    for title, (stem, line) in texts.items():
        yield (
            f"COLMAP's text of {title}",
            Case(partial(_model, _text(f"{stem}.txt", line)), _model_of),
        )
    binaries = {
        "images": ("images.bin", row),
        "cameras": ("cameras.bin", struct.pack("<IiQQ3d", 1, 0, 4, 3, 5, 2, 1)),
        "points": ("points3D.bin", struct.pack("<Q3d3BdQ", 1, 0, 0, 0, 0, 0, 0, 0, 0)),
    }
    for title, (name, data) in binaries.items():
        for count in (None, 2**64 - 1):
            make = partial(_rows, name, data, count)
            ending = "" if count is None else ", of which it promises more"
            yield f"COLMAP's {title}{ending}", Case(partial(_model, make), _model_of)


def _rows(name: str, row: bytes, promised: int | None, folder: Path, size: int) -> Path:
    count = size // len(row)
    (folder / name).write_bytes(struct.pack("<Q", promised or count) + row * count)
    return folder / name


def _model(make: Callable[[Path, int], Path], folder: Path, size: int) -> Path:
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 4, 3, 5, 5, 2, 1)
    (folder / "cameras.bin").write_bytes(camera)
    (folder / "images.bin").write_bytes(bytes(8))
    (folder / "cameras.txt").write_text("1 PINHOLE 4 3 5 5 2 1\n")
    (folder / "images.txt").write_text("")
    return make(folder, size)


def _model_of(path: Path) -> object:
    model = ColmapModel(path.parent, path.suffix)
    return read_images(model), read_points3d(model)


def _moved_photos(folder: Path, _size: int) -> Path:
    photo, count = png(np.zeros((3, 4), np.uint8)), 16_000
    (folder / "images" / "a").mkdir(parents=True)
    for number in range(count):
        (folder / "images" / "a" / f"{number}.png").write_bytes(photo)
    _text("sparse/0/images.txt", "1 1 0 0 0 0 0 0 1 @.png\n\n")(folder, 25 * count)
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 4 3 5 5 2 1\n")
    return folder


def _read_colmap(folder: Path) -> object:
    model = find_model(folder.resolve())
    assert model is not None
    return read_colmap(folder.resolve(), model, ReadingNotes())


def _ply() -> Iterator[tuple[str, Case]]:
    def make(form: str, kind: str, row: bytes, more: str, folder: Path, size: int) -> Path:
        columns = "".join(f"property {kind} {axis}\n" for axis in "xyz") + more
        count = size // len(row)
        head = f"ply\nformat {form} 1.0\nelement vertex {count}\n{columns}end_header\n"
        (folder / "a.ply").write_bytes(head.encode() + row * count)
        return folder / "a.ply"

    for title, *parts in (
        ("text", "ascii", "float", b"1 1 1 ", ""),
        ("bytes", "binary_little_endian", "uchar", bytes(3), ""),
        ("columns", "binary_little_endian", "uchar", bytes(2003),
         "".join(f"property uchar p{n}\n" for n in range(2000))),
    ):  # fmt: skip
        yield f"PLY of {title}", Case(partial(make, *parts), read_ply)


def _small_parts() -> Iterator[tuple[str, Case]]:
    """Photos of many small parts: segments of a JPEG, chunks of a PNG, tags and strips of a
    TIFF."""
    photo = jpg(np.zeros((30, 40, 3), np.uint8))
    parts = {
        "nothing": b"\xff\xe1\0\2", "fill": b"\xff", "restarts": b"\xff\xd0",
        "records": b"\xff\xe1\0\x0aFLIR\0\1\0\0", "Workswell's": b"\xff\xe1\0\x0aWORK\0\1\0\0",
        "EXIF": b"\xff\xe1\0\x08Exif\0\0", "XMP": b"\xff\xe1\0\x20http://ns.adobe.com/xap/1.0/\0a",
        "profiles": b"\xff\xe2\0\x12ICC_PROFILE\0\1\1ab",
    }  # fmt: skip

    def jpeg(part: bytes, folder: Path, size: int) -> Path:
        (folder / "a.jpg").write_bytes(photo[:2] + part * (size // len(part)) + photo[2:])
        return folder / "a.jpg"

    def chunks(part: bytes, folder: Path, size: int) -> Path:
        more = part * (size // len(part))
        (folder / "a.png").write_bytes(_png(10, 8, 0, more))
        return folder / "a.png"

    for title, part in parts.items():
        yield f"JPEG of {title}", Case(partial(jpeg, part), _as_photo)
    for title, part in (("chunks", _chunk(b"abCd", b"")), ("texts", _chunk(b"tEXt", b"a\0b"))):
        yield f"PNG of {title}", Case(partial(chunks, part), _as_photo)
    text = zlib.compress(bytes(60_000_000), 9)
    unfolding = _chunk(b"zTXt", b"a\0\0" + text)
    yield "PNG of texts that unfold", Case(partial(chunks, unfolding), _as_photo)
    # Earlier versions of Pillow read the bytes again for each tag that names them.
    for kind in (2, 3, 5) if int(PIL.__version__.partition(".")[0]) >= 13 else ():
        yield f"TIFF of tags of type {kind}", Case(partial(_tags, kind), _as_photo)
    yield "TIFF of strips", Case(_strips, _as_photo)
    for title, tag, line in (
        ("GDAL's items", 42112, b'<Item role="scale">1</Item>'), ("open items", 42112, b"<Item "),
        ("bands", 700, b"BandName>"), ("a long band", 700, b"A"), ("gains", 700, b"TlinearGain='"),
    ):  # fmt: skip
        yield f"TIFF of {title}", Case(partial(_described, tag, line), _as_photo)


def _as_photo(path: Path) -> object:
    take_inventory(path.parent)
    decode(path)
    return read_thermal_photo(path)


def _tiff(entries: list[tuple[int, int, int, int]], rest: bytes = b"", bits: int = 8) -> bytes:
    """A TIFF of 4×3 pixels, with further tags: number, type, count, and value or place."""
    usual = {
        256: (4, 4), 257: (4, 3), 258: (3, bits), 259: (3, 1), 262: (3, 1), 273: (4, 8),
        277: (3, 1), 278: (4, 3), 279: (4, 3 * bits // 2),
    }  # fmt: skip
    own = {each[0] for each in entries}
    tags = [(tag, kind, 1, value) for tag, (kind, value) in usual.items() if tag not in own]
    tags = sorted([*tags, *entries])
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    return head + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4) + rest


def _tags(kind: int, folder: Path, size: int) -> Path:
    """Half of the file are tags that all name the other half."""
    count, width = min(size // 24, 60_000), {2: 1, 3: 2, 5: 8}[kind]
    begin = 14 + 12 * (count + 9)
    tags = [(1000 + n, kind, (size - begin) // width, begin) for n in range(count)]
    (folder / "a.tiff").write_bytes(_tiff(tags, b"\1" * (size - begin)))
    return folder / "a.tiff"


def _strips(folder: Path, size: int) -> Path:
    count, begin = size // 8, 14 + 12 * 9
    places = struct.pack(f"<{2 * count}I", *[8] * count, *[1] * count)
    tags = [(256, 4, 1, 1), (257, 4, 1, count), (273, 4, count, begin), (278, 4, 1, 1)]
    tags += [(279, 4, count, begin + 4 * count)]
    (folder / "a.tiff").write_bytes(_tiff(tags, places))
    return folder / "a.tiff"


def _described(tag: int, line: bytes, folder: Path, size: int) -> Path:
    text = (b"BandName>" if line == b"A" else b"") + line * (size // len(line))
    place = 14 + 12 * 10
    kind, bits = (2, 8) if tag == 42112 else (1, 16)
    (folder / "a.tiff").write_bytes(_tiff([(tag, kind, len(text), place)], text, bits))
    return folder / "a.tiff"


def _checkpoint(folder: Path, size: int) -> Path:
    empty = {f"{number:07}": torch.zeros(0) for number in range(size // 55)}
    checkpoint.write_file(folder / "step_000001.safetensors", empty, {})
    return folder / "step_000001.safetensors"


def _yaml() -> Iterator[tuple[str, Case]]:
    lines = {
        "lists": ("[", "[],"), "entries": ("[", "a,"), "keys": ("", "@: 1\n"), "blanks": ("", " "),
        "quotes": ('a: "', "\\\n"), "text": ("a: ", "b\n "), "tags": ("", "- !!str a\n"),
        "documents": ("", "---\n"), "sets": ("a: !!set {", "a@,"), "hyphens": ("", "- "),
        "digits": ("a: 0x", "f"), "colons": ("a: 1", ":1"),
    }  # fmt: skip
    for title, (head, line) in lines.items():
        make = _text("survey.yaml", line, head)
        yield f"YAML of {title}", Case(lambda at, size, make=make: make(at, min(size, 99_000)), read_survey)  # fmt: skip # noqa: E501


def _images() -> Iterator[tuple[str, Case]]:
    def write(name: str, content: Callable[[], bytes], folder: Path, _size: int) -> Path:
        (folder / name).write_bytes(content())
        return folder / name

    for title, bits, kind in (("RGB", 8, 2), ("RGBA of 16 bits", 16, 6), ("counts", 16, 0)):
        make = partial(write, "a.png", partial(_png, WIDE, bits, kind))
        yield f"PNG of {title}", Case(make, decode)
        yield f"PNG of {title}, as a thermal photo", Case(make, read_thermal_photo)
    make = partial(write, "a.png", partial(_png, WIDE, 8, 2))
    yield "PNG that is turned", Case(make, lambda path: read_rgb(path, 6))
    raw = partial(_png, WIDE, 16, 0)
    yield "FLIR's record of a large PNG", Case(
        partial(write, "a.jpg", lambda: FlirPhoto().jpeg(FlirPhoto(
            raw_content=struct.pack("<3H26x", 2, WIDE, WIDE) + raw()
        ).record())), read_thermal_photo,
    )  # fmt: skip
    yield "JPEG of scans", Case(partial(write, "a.jpg", _scans), decode)
    floats = partial(write, "a.tiff", _floats)
    yield "TIFF of floats", Case(floats, read_thermal_photo)
    yield "TIFF of floats, decoded", Case(floats, decode)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _png(width: int, bits: int, kind: int, more: bytes = b"") -> bytes:
    """A square image of zeros, with further chunks."""
    row = bytes(1 + width * {0: 1, 2: 3, 6: 4}[kind] * bits // 8)
    packer = zlib.compressobj(9)
    pixels = b"".join(packer.compress(row) for _ in range(width)) + packer.flush()
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, width, bits, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + more + _chunk(b"IDAT", pixels) + _chunk(b"IEND", b"")


def _scans() -> bytes:
    """A JPEG of three channels, each of which stands in thousands of empty scans."""
    parts = [b"\xff\xd8\xff\xdb\0\x43\0" + bytes([1] * 64)]
    parts += [b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, WIDE, WIDE, 3)]
    parts += [bytes([number, 0x11, 0]) for number in (1, 2, 3)]
    parts += [b"\xff\xc4\0\x14" + bytes([kind, 1, *[0] * 16]) for kind in (0, 0x10)]
    scans = [b"\xff\xda\0\x08\1" + bytes([1 + n % 3, 0, 0, 63, 0]) for n in range(5_000)]
    return b"".join([*parts, *scans, b"\xff\xd9"])


def _floats() -> bytes:
    """A TIFF of one strip of floats, all 1, packed by deflate."""
    row, packer = struct.pack("<f", 1) * WIDE, zlib.compressobj(9)
    pixels = b"".join(packer.compress(row) for _ in range(WIDE)) + packer.flush()
    place = 14 + 12 * 10
    tags = [(256, 4, 1, WIDE), (257, 4, 1, WIDE), (258, 3, 1, 32), (259, 3, 1, 8)]
    tags += [(273, 4, 1, place), (278, 4, 1, WIDE), (279, 4, 1, len(pixels)), (339, 3, 1, 3)]
    return _tiff(tags, pixels)
