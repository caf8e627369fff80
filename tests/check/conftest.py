from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from mrgs.check import cameras, photos
from mrgs.check.photos import WIDTH_PX, measure
from mrgs.check.problem import Evidence, ImageStatistics, Problem
from mrgs.check.rules import RULES
from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.scene import Modality, PosedImage, Scene, View

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"


def problems_of(module: object, evidence: Evidence) -> list[Problem]:
    """What the rules of a module find."""
    own = [rule.find for rule in RULES if rule.find.__module__ == module.__name__]
    return [problem for find in own for problem in find(evidence)]


def pose_problems(scene: Scene) -> list[Problem]:
    """Problems that need no pixels."""
    return problems_of(cameras, Evidence(scene))


def measured(view: View) -> dict[Modality, ImageStatistics | str]:
    """The statistics of the view's photos, or why one cannot be read."""

    def of(image: PosedImage) -> ImageStatistics | str:
        try:
            return measure(image.look(WIDTH_PX), image)
        except SceneError as error:
            return str(error)

    return {modality: of(image) for modality, image in view.images.items()}


@dataclass(frozen=True, eq=False)
class Checked:
    """A scene and the statistics of its photos, by view."""

    scene: Scene
    statistics: dict[str, dict[Modality, ImageStatistics | str]]

    @property
    def evidence(self) -> Evidence:
        photos: dict[Modality, dict[str, ImageStatistics]] = {}
        unreadable = []
        for view in self.scene.views:
            for modality, found in self.statistics.get(view.name, {}).items():
                if isinstance(found, str):
                    unreadable.append(found)
                else:
                    photos.setdefault(modality, {})[view.name] = found
        return Evidence(self.scene, photos, unreadable)

    def problems(self) -> list[Problem]:
        return [problem for rule in RULES for problem in rule.find(self.evidence)]

    def photo_problems(self) -> list[Problem]:
        return problems_of(photos, self.evidence)

    def changed(self, change: Callable[[View], View], every: int = 1, first: int = 0) -> Checked:
        """Some of the training views changed: ``first``, and each ``every``-th after it."""
        train = list(self.scene.train)
        statistics = dict(self.statistics)
        for index in range(first, len(train), every):
            train[index] = change(train[index])
            name = train[index].name
            statistics[name] = measured(train[index])
        return Checked(replace(self.scene, train=tuple(train)), statistics)

    def posed(self, change: Callable[[View], View], every: int = 1, first: int = 0) -> Checked:
        """The same for changes of the cameras alone, in all views: the pixels are not read
        again."""
        views = [*self.scene.views]
        for index in range(first, len(views), every):
            views[index] = change(views[index])
        count = len(self.scene.train)
        return Checked(
            replace(self.scene, train=tuple(views[:count]), eval=tuple(views[count:])),
            self.statistics,
        )


@pytest.fixture(scope="session")
def tabletop() -> Checked:
    """The bundled scene with every second of its training views; only to be read."""
    scene = load_scene(TABLETOP)
    scene = replace(scene, train=scene.train[::2])
    views = [*scene.views]
    return Checked(scene, {view.name: measured(view) for view in views})
