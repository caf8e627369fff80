from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import pytest

from mrgs.errors import ConfigError
from mrgs.system.strict_yaml import read_yaml, write_yaml


@dataclass(frozen=True)
class Disc:
    name: Literal["disc"] = "disc"
    radius: float = 1.0


@dataclass(frozen=True)
class Box:
    name: Literal["box"] = "box"
    width: float = 2.0


@dataclass(frozen=True)
class Scene:
    shape: Disc | Box = field(default_factory=Disc)


@pytest.mark.parametrize("scene", [Scene(), Scene(Disc(radius=3.0)), Scene(Box(width=5.0))])
def test_members_of_a_union_are_told_apart_by_their_names(scene):
    assert read_yaml(Scene, write_yaml(scene), "scene.yaml") == scene


def test_what_names_no_member_is_the_first():
    assert read_yaml(Scene, "shape: {radius: 4}", "scene.yaml") == Scene(Disc(radius=4.0))


def test_another_member_takes_nothing_of_the_base():
    base = Scene(Disc(radius=7.0))
    assert read_yaml(Scene, "shape: {name: box}", "x.yaml", base) == Scene(Box())
    assert read_yaml(Scene, "shape: {name: disc}", "x.yaml", base) == base


def test_a_member_that_does_not_exist_is_named():
    with pytest.raises(ConfigError, match=r"x\.yaml: shape: .*'cone'"):
        read_yaml(Scene, "shape: {name: cone}", "x.yaml")
