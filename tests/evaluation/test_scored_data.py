from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from mrgs.data import load_scene
from mrgs.evaluation.report import ScoredData
from mrgs.run_files.facts import fingerprints
from mrgs.scene import Scene


@pytest.fixture
def scene(small_scene) -> Scene:
    return load_scene(small_scene)


@pytest.mark.parametrize("celsius", [True, False])
@pytest.mark.parametrize("trained", [True, False])
def test_the_data_survive_json_without_a_null(celsius, trained, scene):
    if not celsius:
        scene = replace(scene, temperature=None)
    data = ScoredData.of(scene, fingerprints(scene) if trained else ())
    text = json.dumps(data.to_json())
    assert "null" not in text
    assert ScoredData.from_json(json.loads(text)) == data
    assert data.changes(ScoredData.of(scene, fingerprints(scene)), scene) == ""


@pytest.mark.parametrize(
    "value",
    [None, [], {}, {"held_out": 3}, {"held_out": [["digest", [1.0], [1.0]]]},
     {"held_out": [], "temperature_c": 7}],
)  # fmt: skip
def test_what_is_no_data_is_not_known(value):
    assert ScoredData.from_json(value) is None


def test_what_has_changed_is_named(scene):
    data = ScoredData.of(scene, fingerprints(scene))
    warmer = replace(data, temperature_c=(0.0, 99.0))
    assert "temperature range" in data.changes(warmer, scene)
    assert data.changes(replace(data, training_photos="0"), scene) == "training photos"
    fewer = replace(data, held_out=data.held_out[:3])
    assert re.search("3 held-out .*4", data.changes(fewer, scene))
    first, *others = data.held_out
    photo = replace(data, held_out=(first._replace(photo="0"), *others))
    assert data.changes(photo, scene).endswith(f"{scene.eval[0].name} (rgb)")
    rounded = tuple(number * (1 + 1e-8) for number in first.pose)
    moved = replace(data, held_out=(first._replace(pose=rounded), *others))
    assert data.changes(moved, scene) == ""
