"""Every reader of text on texts that are almost right: read, or refused in one line."""

from __future__ import annotations

import json
import math
import random
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mrgs.app.terminal import read_text
from mrgs.blocks.plan import BlockOptions, BlockPlan, PlannedBlock, config_values, read_plan
from mrgs.blocks.region import Rectangle, ScenePlane
from mrgs.data.colmap import ColmapModel, read_images, read_points3d
from mrgs.data.load import read_bounds
from mrgs.data.nerfstudio import read_transforms
from mrgs.data.ply import read_ply
from mrgs.data.radiometric import read_thermal_photo
from mrgs.data.sources import ReadingNotes
from mrgs.errors import MrgsError, MrgsWarning
from mrgs.marks.mark import Mark
from mrgs.marks.store import CameraSpread, MarkStore
from mrgs.prepare.pairs.find import by_table
from mrgs.prepare.pairs.inventory import take_inventory
from mrgs.prepare.thermal_camera import read_thermal_camera
from mrgs.runs.registry import find_method
from mrgs.survey import read_survey
from mrgs.system.strict_yaml import write_yaml
from tests.faults.tally import Tally
from tests.helpers.scenes import write_scene

TOKEN = re.compile(r"[\w.+-]+|\s+|[^\w\s]")
ODD = (
    *"\0 \n\t,;:'\"[]{}#|>&*!?%@`-/\\=",
    "nan", "NaN", "-inf", "1e999", "-0", "0", "-1", "1.5", "1e308", "99999999999999999999",
    "9" * 401, "0x" + "f" * 5000, "1_000", "12:30:59", "2026-13-45", "true", "null", "~", "no",
    "é", "\u202e", "\ud83d", "\ufeff", "\x1b[31m", "\r\n", "../..", "/dev/zero", "C:\\a", "a" * 300,
    "!!int", "<<", "*a", "&a", "- - -", '"a": 1', "{}", "[]", '""',
)  # fmt: skip
"""What is put in place of parts of a text, and between them."""


class Reader(NamedTuple):
    """A file's name, a text that is right, and what reads it."""

    name: str
    text: str
    read: Callable[[Path], object]


def readers(folder: Path) -> Mapping[str, Reader]:
    """Every reader of texts that a stranger may send, by its title."""
    scene = write_scene(folder / "scene")
    photos = take_inventory(scene)
    names = [photo.name for photo in photos.photos]
    halves = names[: len(names) // 2], names[len(names) // 2 :]
    pairs = "rgb,thermal\n" + "".join(f"{a},{b}\n" for a, b in zip(*halves, strict=False))
    rows = "\n".join(";".join(f"{20 + x / 7 + y:.2f}" for x in range(6)) for y in range(5))
    lens = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0, "k1": 0.01}
    spread = CameraSpread.of(np.arange(12.0).reshape(4, 3))
    store = MarkStore(folder, spread)
    spot = Mark("S1", "spot", ((0.0, 0.0, 0.0),), (0.0, -5.0, 0.0), 0.1, note="wet")
    store.edit(lambda marks: replace(marks, marks=(spot, replace(spot, name="R")), reference="R"))
    config = find_method("mrgs-plus").make_config(preset="fast")
    cells = (PlannedBlock(Rectangle((-math.inf, 0.0), (1.0, math.inf)), (0, 2)),)
    plane = ScenePlane(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (0.0, 0.0), (2.0, 1.0))
    plan = BlockPlan("/scene", config_values(config), BlockOptions(), plane, 0.1, cells)
    plan.write(folder / "blocks.json")
    return {
        "survey": Reader("survey.yaml", _SURVEY, read_survey),
        "configuration": Reader("config.yaml", write_yaml(config), _configuration),
        "transforms": Reader(
            "transforms.json",
            (scene / "transforms.json").read_text(encoding="utf-8"),
            lambda path: read_transforms(scene.resolve(), path),
        ),
        "bounds": Reader(
            "temperature_bounds.json",
            '{"absolute_min_temperature": 10, "absolute_max_temperature": 30.5, "unit": "°C"}',
            lambda path: read_bounds(path.parent, ReadingNotes()),
        ),
        "thermal camera": Reader(
            "camera.json",
            json.dumps({"thermal_camera": lens, "thermal_from_rgb_m": np.eye(4).tolist()}),
            read_thermal_camera,
        ),
        "cameras of COLMAP": Reader("cameras.txt", "1 OPENCV 40 30 50 50 20 15 0 0 0 0\n", _images),
        "images of COLMAP": Reader("images.txt", "1 1 0 0 0 0 0 1 1 a.jpg\n1 2 3\n", _images),
        "points of COLMAP": Reader(
            "points3D.txt", "1 0.5 1 2 200 100 50 0.3 1 0 2 1\n",
            lambda path: read_points3d(ColmapModel(path.parent, ".txt")),
        ),
        "points": Reader("points.ply", _PLY, read_ply),
        "thermal table": Reader(
            "photo.csv", "Emissivity;0.95\nunit °C\n" + rows, read_thermal_photo
        ),
        "pairs": Reader("pairs.csv", pairs, lambda path: by_table(path, photos)),
        "marks": Reader(
            "marks.json", store.file.read_text(encoding="utf-8"),
            lambda path: MarkStore(path.parent, spread).read(),
        ),
        "plan of blocks": Reader(
            "blocks.json", (folder / "blocks.json").read_text(encoding="utf-8"), read_plan
        ),
    }  # fmt: skip


_SURVEY = """title: "House"
date: 2026-01-12
time: "06:30 to 07:10"
standard: EN 13187
side: inside
inside_c: 20.5
outside_c: -3
wind_m_s: 1.5
hot_places: 2
remarks: |
  first
  second
"""

_PLY = """ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
0 0 1 255 0 0
1 2 3.5 0 10 20
"""


def _configuration(path: Path) -> object:
    method = find_method("mrgs-plus")
    return method.configure(preset="fast", changes=read_text(path), source=path.name)


def _images(path: Path) -> object:
    return read_images(ColmapModel(path.parent, ".txt"))


def attack(folder: Path, name: str, inputs: int, seed: int = 0) -> Tally:
    """Read texts in which up to three parts are others, missing, doubled or moved."""
    reader, rng, tally = readers(folder)[name], random.Random(f"{name} {seed}"), Tally()
    path = folder / name / reader.name
    path.parent.mkdir()
    for other in ("cameras.txt", "images.txt"):
        good = {"cameras.txt": "1 PINHOLE 40 30 50 50 20 15\n", "images.txt": ""}[other]
        path.with_name(other).write_text(good)
    parts = TOKEN.findall(reader.text)
    _judge(tally, reader, path, reader.text)
    for _ in range(inputs):
        _judge(tally, reader, path, _changed(parts, rng))
        if len(tally.failures) >= 10:
            break
    return tally


def attacks(folder: Path, inputs: int, seed: int = 0) -> Tally:
    """Every reader attacked."""
    tally = Tally()
    (folder / "readers").mkdir()
    for number, name in enumerate(readers(folder / "readers")):
        (folder / str(number)).mkdir()
        found = attack(folder / str(number), name, inputs, seed)
        tally.tried += found.tried
        tally.failures += [f"{name}: {each}" for each in found.failures]
    return tally


def _changed(parts: list[str], rng: random.Random) -> str:
    parts = list(parts)
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(len(parts))
        kind = rng.randrange(5)
        if kind == 0:
            parts[place] = rng.choice(ODD)
        elif kind == 1:
            parts.insert(place, rng.choice(ODD))
        elif kind == 2:
            parts[place : place + rng.choice((1, 1, 4, 40))] = [""]
        elif kind == 3:
            parts.insert(rng.randrange(len(parts)), "".join(parts[place : place + 12]))
        else:
            other = rng.randrange(len(parts))
            parts[place], parts[other] = parts[other], parts[place]
    return "".join(parts)


def _judge(tally: Tally, reader: Reader, path: Path, text: str) -> None:
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MrgsWarning)
            reader.read(path)
    except MrgsError as error:
        tally.judge(repr(text), str(error).isprintable() and len(str(error)) < 1000, str(error))
    except Exception as error:
        tally.judge(repr(text), False, repr(error)[:200])
    else:
        tally.judge("", True)
    for aside in path.parent.glob("*.damaged*"):
        aside.unlink()
