"""Whatever happens to the bytes of a scene, the answer is a Scene or a SceneError."""

from __future__ import annotations

import copy
import json
import random
import warnings
from pathlib import Path

import pytest

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.scene import Scene

ODD_VALUES = [
    None,
    True,
    -1,
    0,
    1e300,
    float("nan"),
    float("inf"),
    10**400,
    "",
    "x",
    "../x",
    "a\0",
    [],
    {},
    [[]],
    [{}],
]


def opens_or_refuses(root: Path) -> bool:
    """Whether the scene opened; fails for any exception but a SceneError of one line."""
    message = ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene = load_scene(root)
        except SceneError as error:
            message = str(error)
    if message:
        assert "\n" not in message
        return False
    assert isinstance(scene, Scene)
    assert scene.train
    return True


def mutate_json(value, rng: random.Random):
    """Replace, remove or exchange one entry somewhere below."""
    value = copy.deepcopy(value)
    at = value
    while True:
        key = rng.choice(list(at)) if isinstance(at, dict) else rng.randrange(len(at))
        if isinstance(at[key], dict | list) and at[key] and rng.random() < 0.8:
            at = at[key]
            continue
        if isinstance(at, dict) and rng.random() < 0.2:
            del at[key]
        else:
            at[key] = rng.choice(ODD_VALUES)
        return value


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    mutated = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(mutated))
        match rng.randrange(4):
            case 0:
                mutated[start] = rng.randrange(256)
            case 1:
                mutated[start : start + 8] = rng.choice(
                    [b"\xff" * 8, b"\0" * 8, b"\x7f" + b"\xff" * 7]
                )
            case 2:
                del mutated[start : start + rng.randint(1, 8)]
            case 3:
                mutated[start:start] = mutated[start : start + 16]
        if not mutated:
            break
    return bytes(mutated)


def test_transforms_json(writer):
    content = writer.thermoscenes(train=2, held_out=1)
    content.update(applied_transform=[[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]], applied_scale=2.0)
    content["thermal_camera"] = {"w": 24, "h": 16, "fl_x": 20.0, "fl_y": 20.0, "k1": -0.1}
    content["modalities"] = [{"name": "nir", "channels": 1, "unit": "W", "title": "Near infrared"}]
    content["train_filenames"] = [frame["file_path"] for frame in content["frames"][:2]]
    content["val_filenames"] = [content["frames"][2]["file_path"]]
    content["k1"] = -0.2
    writer.colmap(["a.png"], binary=False, folder="colmap/sparse/0")
    writer.transforms(content)
    assert opens_or_refuses(writer.root)
    rng = random.Random(0)
    opened = 0
    for _ in range(250):
        writer.transforms(mutate_json(content, rng))
        opened += opens_or_refuses(writer.root)
    assert 10 < opened < 240
    text = json.dumps(content).encode()
    for _ in range(60):
        (writer.root / "transforms.json").write_bytes(mutate_bytes(text, rng))
        opens_or_refuses(writer.root)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply(writer, form):
    head = f"ply\nformat {form} 1.0\nelement vertex 3\n" + "".join(
        f"property {kind} {name}\n"
        for kind, names in (("float", "xyz"), ("uchar", ("red", "green", "blue")))
        for name in names
    )
    body = b"1 2 3 4 5 6\n" * 3 if form == "ascii" else bytes(range(45))
    data = head.encode() + b"end_header\n" + body
    writer.transforms(writer.thermoscenes(train=2, held_out=0))
    rng = random.Random(1)
    for _ in range(150):
        (writer.root / "sparse_pc.ply").write_bytes(mutate_bytes(data, rng))
        opens_or_refuses(writer.root)


@pytest.mark.parametrize("binary", [True, False])
def test_colmap(writer, binary):
    names = [f"{index}.png" for index in range(3)]
    for name in names:
        writer.image(f"images/{name}")
    folder = writer.colmap(names, binary)
    originals = {path: path.read_bytes() for path in sorted(folder.iterdir())}
    assert opens_or_refuses(writer.root)
    rng = random.Random(2)
    for _ in range(150):
        path = rng.choice(list(originals))
        path.write_bytes(mutate_bytes(originals[path], rng))
        opens_or_refuses(writer.root)
        path.write_bytes(originals[path])
