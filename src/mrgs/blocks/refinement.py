"""Refining a part of a whole scene's model: a block of it, or the seam about one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.blocks.plan import BlockPlan, Surveyor, counted_places, views_of
from mrgs.blocks.region import Rectangle, Ring, ScenePlane
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.camera_model.point_spread import PointSpread
from mrgs.method.config import TrainConfig, with_steps
from mrgs.method.density import DensityStep, DensityUpdate, Strategy, StrategyState
from mrgs.method.losses.terms import configured_terms
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.method.start.fitted_residuals import leave_the_rest
from mrgs.method.start.overlap import without_camera
from mrgs.method.start.start_points import initial_gaussians, start_points
from mrgs.render import Model, ScreenPoints, rows_in_view
from mrgs.run_files.folder import RunFolder
from mrgs.scene import THERMAL, Gaussians, PointCloud, Scene, SceneBounds
from mrgs.scene.capture import Capture
from mrgs.system.torch_modes import seeded
from mrgs.training.checkpoint import load_model
from mrgs.training.start import TrainingPart
from mrgs.training.state import TrainingState

EXTENT = 3.0
"""Assumed radius of a Gaussian, in its largest standard deviations."""

WIDEST = 1 / 3
"""Largest standard deviation of a Gaussian that blocks take over from the coarse model, as a share
of their overlap: no block may move a wider one, see ``EXTENT``."""

SEAM_WIDTH = 1 / 3
"""Half width of the strip along an edge refined after joining, as a share of blocks' overlap."""

SEAM_EXTENT = 1.0
"""Assumed radius of a Gaussian in a seam, in its largest standard deviations: smaller, so that wide
ones may move, in which the blocks differ most."""

SEAM_STEPS = 0.2
"""Steps of a seam, as a share of a block's."""


@dataclass(frozen=True)
class Part:
    """A part of a scene: a region of its plane, without the background.

    Attributes:
        counted: the region whose pixels count in photos; the same or a larger one.
        reach: bounds of the scene.
        extent: assumed radius of a Gaussian, in its largest standard deviations.
    """

    plane: ScenePlane
    region: Rectangle | Ring
    counted: Rectangle | Ring
    reach: SceneBounds
    extent: float = EXTENT

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether points of the world belong to it."""
        inside = self.region.contains(self.plane.coordinates(points))
        return inside & ~self.reach.is_background(points)

    @torch.no_grad()
    def holds(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Which Gaussians belong to it and reach no farther than photos count."""
        places = self.plane.coordinates(gaussians.means)
        seen = self.counted.contains(places, self.extent * gaussians.scales.amax(dim=1))
        return seen & self.contains(gaussians.means)


@dataclass(frozen=True)
class LocalDensityControl(Strategy):
    """Another strategy's density control for the Gaussians of a part of a scene."""

    inner: Strategy = field(kw_only=True)
    part: Part = field(kw_only=True)

    def settings(self) -> Mapping[str, object]:
        """Nothing: the settings follow from the plan of the blocks, which is compared."""
        return {}

    def initial_state(self, gaussians: Gaussians) -> StrategyState:  # noqa: D102
        return self.inner.initial_state(gaussians)

    def movable(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Which Gaussians are in the part. The others keep the values that all parts share: no
        pixel that counts here shows what they do elsewhere."""
        return self.part.holds(gaussians)

    def observe(  # noqa: D102
        self, passes: Sequence[ScreenPoints]
    ) -> Mapping[str, Float[Tensor, " n"]]:
        return self.inner.observe(passes)

    def after_step(  # noqa: D102
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        inside = self.movable(optimizer.gaussians)
        observed = {name: torch.where(inside, each, 0) for name, each in step.observed.items()}
        return self.inner.after_step(state, optimizer, step._replace(observed=observed))


@dataclass(frozen=True)
class FixedGaussians(Strategy):
    """No Gaussians are added or removed."""

    def after_step(  # noqa: D102
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        return DensityUpdate(state)


class WholeModel(NamedTuple):
    """A model of a whole scene, and what the cameras do to its images."""

    model: Model
    image_model: ImageModel

    @classmethod
    def of(cls, folder: RunFolder, config: TrainConfig) -> WholeModel:
        """The model of a finished run. RunError if it cannot be read."""
        model, _, image_model = folder.load_newest(lambda path: load_model(path, config))
        return cls(model, image_model)

    def with_new_blur(self) -> WholeModel:
        """The model with the blur of the thermal camera as any training starts with it. What a
        coarse model learns is too small, as its Gaussians are blurred themselves; below a third of
        a pixel a blur has no gradient that would make it larger."""
        image_model = deepcopy(self.image_model)
        if image_model.point_spread is not None:
            image_model.point_spread = PointSpread()
        return WholeModel(self.model, image_model)


@dataclass(frozen=True, eq=False)
class Refinement:
    """A training that refines a part of a model.

    Attributes:
        part: what is refined; everything else stays as it is.
        views: training views that show it.
        density: control of the part's Gaussians.
        rows: Gaussians of the model that are in the part, or that its views show.
        points: that the part starts from, in place of the model's Gaussians in it; None for these.
    """

    start: WholeModel
    part: Part
    views: tuple[int, ...]
    config: TrainConfig
    density: Strategy
    rows: Int64[Tensor, " k"]
    points: PointCloud | None = None

    @property
    def inside(self) -> Bool[Tensor, " k"]:
        """Which of ``rows`` are in the part, and so may move."""
        return self.part.holds(self.start.model.gaussians)[self.rows]

    @property
    def training_part(self) -> TrainingPart:
        """What a training must know to refine the part."""
        fixed = int((~self.inside).sum())
        most = self.density.max_gaussians + fixed
        strategy = LocalDensityControl(
            max_gaussians=most, inner=replace(self.density, max_gaussians=most), part=self.part
        )
        return TrainingPart(self.views, strategy, partial(self._initial_state, strategy))

    def _initial_state(
        self, strategy: Strategy, scene: Scene, config: TrainConfig, device: torch.device
    ) -> TrainingState:
        chosen = self.start.model.gaussians.rows(self.rows)
        with seeded(config.seed):
            if self.points is not None:
                chosen = chosen.followed_by(self._from_points(self.points, scene, config))
            terms = configured_terms(config, (), chosen.modalities)
        model = replace(self.start.model, gaussians=chosen, neighbours=None, sh_degree=0)
        model = model.to(device)
        generator = torch.Generator().manual_seed(config.seed)
        state = TrainingState.around(model, terms, strategy, config, Capture.of(scene), generator)
        state.image_model.load_state_dict(self.start.image_model.state_dict())
        return state

    def _from_points(self, points: PointCloud, scene: Scene, config: TrainConfig) -> Gaussians:
        """New Gaussians at points, as a training of the whole would start with them."""
        shown = without_camera(scene, self.start.image_model)
        views = tuple(shown.train[number] for number in self.views)
        config = replace(config, distant_points=False)
        generator = torch.Generator().manual_seed(config.seed)
        start = start_points(replace(scene, points=points, train=views), config)
        start = start.at_most(self.density.max_gaussians, generator)
        field = self.start.model.field
        apart = tuple(self.start.model.gaussians.opacity_logits)
        degree = config.temperature_sh_degree_of(Capture.of(scene))
        found = initial_gaussians(start, field, apart, degree)
        if config.fitted_residuals > 0:
            neighbours = field.neighbours_of(found.means)
            leave_the_rest(field, found, start.values[THERMAL], neighbours)
        return found


def block(
    coarse: WholeModel, scene: Scene, plan: BlockPlan, number: int, config: TrainConfig
) -> Refinement:
    """The refinement of a block, and of the strip about it, from the coarse model; or from the
    scene's points, where these are more than the coarse model's Gaussians there.
    """
    cell = plan.cells[number]
    coarse = coarse.with_new_blur()
    region = cell.region.grown(plan.overlap)
    part = Part(plan.plane, region, region, scene.reach)
    own = _local(config, scene, cell.views, number)
    rows = _rows(coarse.model, scene, part, cell.views)
    rows = _without_wide(coarse.model.gaussians, scene, rows, plan.overlap)
    inside = part.contains(coarse.model.gaussians.means.detach()[rows])
    there = part.contains(scene.points.positions)
    points = None
    if not scene.points.random and there.sum() > inside.sum():
        rows, points = rows[~inside], scene.points.rows(there.nonzero()[:, 0])
    return Refinement(coarse, part, cell.views, own, own.densification, rows, points)


def seam(
    joined: WholeModel,
    surveyor: Surveyor,
    scene: Scene,
    plan: BlockPlan,
    number: int,
    config: TrainConfig,
) -> Refinement | None:
    """The refinement of the strip along a block's edges in the joined model; None if no photo shows
    it. No Gaussians are added or removed."""
    cell, width = plan.cells[number], SEAM_WIDTH * plan.overlap
    ring, counted = (
        Ring(cell.region.grown(side), cell.region.grown(-side)) for side in (width, plan.overlap)
    )
    part = Part(plan.plane, ring, counted, scene.reach, SEAM_EXTENT)
    shown = replace(scene, train=tuple(scene.train[view] for view in cell.views))
    views = tuple(cell.views[n] for n in views_of(ring, counted_places(surveyor, shown)))
    if not views:
        return None
    steps = max(1, round(SEAM_STEPS * config.max_steps))
    own = _local(with_steps(config, steps), scene, views, len(plan.cells) + number)
    rows = _rows(joined.model, scene, part, views)
    # The rates of the last part of a block's schedule: what is there is good but for the seam.
    means = (own.optimizer.means * own.optimizer.means_final) ** 0.5
    own = replace(own, optimizer=replace(own.optimizer, means=means))
    return Refinement(joined, part, views, own, FixedGaussians(), rows)


def _local(config: TrainConfig, scene: Scene, views: Sequence[int], number: int) -> TrainConfig:
    """The configuration of a part: the whole's, but heads and gains of photos stay, lengths are
    those of the part's cameras, and photos have their full resolution from the start."""
    ratio = replace(scene, train=tuple(scene.train[view] for view in views)).extent / scene.extent

    def scaled(settings: Any, *names: str) -> dict[str, Any]:
        return {name: ratio * getattr(settings, name) for name in names}

    density, optimizer = config.densification, config.optimizer
    return replace(
        config,
        seed=(config.seed + number + 1) % 2**32,
        sh_every=1,
        coarse_until=0.0,
        optimizer=replace(optimizer, heads=0.0, **scaled(optimizer, "means", "means_final")),
        image_model=replace(config.image_model, thermal_gain_rate=0.0, poses_rate=0.0),
        densification=replace(density, **scaled(density, "clone_below", "prune_above")),
    )


def _rows(model: Model, scene: Scene, part: Part, views: Sequence[int]) -> Int64[Tensor, " k"]:
    """The Gaussians of a part, and those that any of its views may show."""
    kept = part.contains(model.gaussians.means.detach())
    for number in views:
        for camera in scene.train[number].cameras.values():
            rows = rows_in_view(model, camera)
            kept[slice(None) if rows is None else rows] = True
    return kept.nonzero()[:, 0]


def _without_wide(
    gaussians: Gaussians, scene: Scene, rows: Int64[Tensor, " k"], overlap: float
) -> Int64[Tensor, " m"]:
    """The rows of Gaussians that are not too wide for any block, and of the background; with a
    narrow overlap, of those of usual width too."""
    widths = gaussians.scales.detach().amax(dim=1)[rows]
    most = max(WIDEST * overlap, 2 * float(widths.median()))
    background = scene.reach.is_background(gaussians.means.detach()[rows])
    return rows[(widths <= most) | background]
