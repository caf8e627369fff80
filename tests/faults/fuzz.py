"""Random files and messages: everything is read, or refused with an error of the program's own."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from mrgs.data.radiometric import read_thermal_photo
from mrgs.errors import MrgsError
from mrgs.prepare.existing import existing_poses
from tests.faults.tally import Tally
from tests.helpers.converted import sizes_of
from tests.helpers.flir import FlirPhoto
from tests.helpers.scenes import write_scene

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)


def radiometric(folder: Path, examples: int) -> Tally:
    """Thermal photos with bytes changed, cut off, or inserted."""
    good = FlirPhoto().record()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "photo.fff"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        read_thermal_photo(path)

    return fuzz(examples, _mutated(good), read)


def poses(folder: Path, examples: int) -> Tally:
    """Pose files for ``prepare`` in which any value is another one."""
    scene = write_scene(folder / "scene")
    content = json.loads((scene / "transforms.json").read_text())
    images = {path.stem: path for path in (scene / "images").iterdir()}
    sizes = sizes_of(images)
    keys = st.sampled_from(sorted(content))
    in_frames = st.sampled_from(sorted(content["frames"][0]))

    def read(change: tuple[bool, str, str, object]) -> None:
        is_frame, key, frame_key, value = change
        frames = [dict(frame) for frame in content["frames"]]
        changed = {**content, "frames": frames}
        if is_frame:
            frames[1][frame_key] = value
        else:
            changed[key] = value
        (scene / "transforms.json").write_text(json.dumps(changed), encoding="utf-8")
        existing_poses(scene, images, sizes)

    return fuzz(examples, st.tuples(st.booleans(), keys, in_frames, JSON), read)


def fuzz(examples: int, strategy: st.SearchStrategy, read: Callable[..., None]) -> Tally:
    """Read values of a strategy; each must be read, or refused with one line."""
    tally = Tally()

    @settings(
        max_examples=examples, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck), phases=(Phase.generate,),
    )  # fmt: skip
    @given(strategy)
    def attack(value: object) -> None:
        try:
            read(value)
        except MrgsError as error:
            tally.judge(repr(value)[:60], "\n" not in str(error), "several lines")
        except Exception as error:
            tally.judge(repr(value)[:60], False, repr(error)[:120])
        else:
            tally.judge("", True)

    attack()
    return tally


def _mutated(good: bytes) -> st.SearchStrategy[bytes]:
    place = st.integers(0, len(good) - 1)
    edits = st.lists(st.tuples(place, st.binary(min_size=1, max_size=8)), max_size=6)

    def edited(change: tuple[list[tuple[int, bytes]], int]) -> bytes:
        data = bytearray(good)
        for start, inserted in change[0]:
            data[start : start + len(inserted)] = inserted
        return bytes(data[: change[1]])

    ends = st.just(len(good)) | st.integers(0, len(good))
    return st.tuples(edits, ends).map(edited)
