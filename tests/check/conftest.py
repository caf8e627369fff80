from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from mrgs.check.images import image_problems
from mrgs.check.poses import pose_problems
from mrgs.check.problems import Problem
from mrgs.check.statistics import ViewStatistics, measure_view
from mrgs.data import load_scene
from mrgs.scene import Scene, View

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"


@dataclass(frozen=True, eq=False)
class Checked:
    """A scene and the statistics of its views."""

    scene: Scene
    statistics: dict[str, ViewStatistics]

    def problems(self) -> list[Problem]:
        views = [*self.scene.views]
        return [
            *pose_problems(self.scene),
            *image_problems(self.scene, [self.statistics[view.name] for view in views]),
        ]

    def changed(self, change: Callable[[View], View], every: int = 1, first: int = 0) -> Checked:
        """Some of the training views changed: ``first``, and each ``every``-th after it."""
        train = list(self.scene.train)
        statistics = dict(self.statistics)
        for index in range(first, len(train), every):
            train[index] = change(train[index])
            name = train[index].name
            statistics[name] = measure_view(train[index], "training", self.scene.temperature, 320)
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
    return Checked(
        scene, {view.name: measure_view(view, "training", scene.temperature, 320) for view in views}
    )
