from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from mrgs.check.images import image_problems
from mrgs.check.looks import Look, look_at
from mrgs.check.poses import pose_problems
from mrgs.check.problems import Problem
from mrgs.data import load_scene
from mrgs.scene import Pixels, PosedImage, Scene, View

TABLETOP = Path(__file__).parents[3] / "examples" / "tabletop"


@dataclass(frozen=True, eq=False)
class Looked:
    """A scene of which every view has been looked at."""

    scene: Scene
    looks: dict[str, Look]

    def problems(self) -> list[Problem]:
        views = [*self.scene.train, *self.scene.eval]
        return [
            *pose_problems(self.scene),
            *image_problems(self.scene, [self.looks[view.name] for view in views]),
        ]

    def changed(self, change: Callable[[View], View], every: int = 1, first: int = 0) -> Looked:
        """Some of the training views changed: ``first``, and each ``every``-th after it."""
        train = list(self.scene.train)
        looks = dict(self.looks)
        for index in range(first, len(train), every):
            train[index] = change(train[index])
            name = train[index].name
            looks[name] = look_at(train[index], "training", self.scene.temperature, 320)
        return Looked(replace(self.scene, train=tuple(train)), looks)

    def posed(self, change: Callable[[View], View], every: int = 1, first: int = 0) -> Looked:
        """The same for changes of the cameras alone, in all views: the pixels are not read
        again."""
        views = [*self.scene.train, *self.scene.eval]
        for index in range(first, len(views), every):
            views[index] = change(views[index])
        count = len(self.scene.train)
        return Looked(
            replace(self.scene, train=tuple(views[:count]), eval=tuple(views[count:])), self.looks
        )


def with_pixels(image: PosedImage, change: Callable[[Pixels], Pixels]) -> PosedImage:
    """The image with other pixels."""
    return replace(image, load=lambda: change(image.load()))


@pytest.fixture(scope="session")
def tabletop() -> Looked:
    """The bundled scene with every second of its training views; only to be read."""
    scene = load_scene(TABLETOP)
    scene = replace(scene, train=scene.train[::2])
    views = [*scene.train, *scene.eval]
    return Looked(
        scene, {view.name: look_at(view, "training", scene.temperature, 320) for view in views}
    )


@pytest.fixture(scope="session")
def repainted() -> Callable[[PosedImage, Callable[[Pixels], Pixels]], PosedImage]:
    """``repainted(image, change)`` has other pixels."""
    return with_pixels
