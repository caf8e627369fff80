"""All that changes during training, and how it is made at step 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int64
from torch import Tensor, nn

from mrgs.errors import NotFiniteError
from mrgs.field import RadianceField
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density import Strategy, StrategyState
from mrgs.method.losses.term import Term
from mrgs.method.losses.terms import configured_terms
from mrgs.method.optimizer import GaussianOptimizer, are_finite
from mrgs.method.start.fitted_residuals import fit_residuals
from mrgs.method.start.overlap import find_from_overlap, without_camera
from mrgs.method.start.start_points import blended_apart, initial_gaussians, start_points
from mrgs.render import Model
from mrgs.scene import THERMAL, Scene
from mrgs.scene.capture import Capture, model_modalities
from mrgs.system.gpu import HOST
from mrgs.system.torch_modes import seeded


class ViewSampler:
    """Every view once per round, each round in a new random order; several views per step are dealt
    into as many groups, one of each a step, with one view of a smaller group twice in a round. A
    checkpoint of the generator and of ``state()`` continues the sequence exactly."""

    def __init__(self, count: int, generator: torch.Generator, groups: int = 1) -> None:
        self._count, self._generator, self._groups = count, generator, groups
        self._views = torch.arange(count)
        self._waiting = torch.empty(0, dtype=torch.int64)

    def restrict(self, views: Sequence[int]) -> None:
        """From the next round on, show only these. ValueError if there are several groups, which
        are dealt from all views."""
        if self._groups > 1:
            raise ValueError("groups of views cannot be restricted")
        self._views = torch.tensor(views)

    def next(self) -> list[int]:
        """The views of the next step, one of each group."""
        if len(self._waiting) == 0:
            longest = -(-len(self._views) // self._groups)
            orders = []
            for first in range(self._groups):
                group = self._views[first :: self._groups]
                order = group[torch.randperm(len(group), generator=self._generator)]
                orders.append(torch.cat([order, order[: longest - len(order)]]))
            self._waiting = torch.stack(orders, dim=1).flatten()
        chosen, self._waiting = self._waiting[: self._groups], self._waiting[self._groups :]
        return chosen.tolist()

    def peek(self) -> list[int]:
        """The views that ``next`` will return; none before a round whose order is not drawn yet."""
        return self._waiting[: self._groups].tolist()

    def state(self) -> Tensor:
        """The rest of the running round."""
        return self._waiting.clone()

    def load(self, waiting: Tensor) -> None:
        """Continue with the rest of a round. ValueError if it names a view that does not exist, a
        view of another group, or one twice."""
        is_list = waiting.dtype == torch.int64 and waiting.dim() == 1
        if not is_list or not set(waiting.tolist()) <= set(range(self._count)):
            raise ValueError(f"the round is not one of {self._count} views")
        steps, rest = divmod(len(waiting), self._groups)
        groups = torch.arange(self._groups).repeat(steps)
        if rest or not torch.equal(waiting % self._groups, groups):
            raise ValueError(f"the round is not one of {self._groups} views per step")
        if self._groups == 1 and len(waiting.unique()) < len(waiting):
            raise ValueError("the round names a view twice")
        self._waiting = waiting


@dataclass
class TrainingState:
    """All that changes during training, and so all that a checkpoint contains.

    Attributes:
        model: what is trained; its Gaussians are those of ``gaussian_optimizer``.
        terms: of the loss, with their learned parameters.
        image_model: what the cameras do to the images.
        layer_optimizer: Adam over the layers of the terms, the field and the image model.
        strategy_state: what the density control remembers.
        sampler: the order of the views.
        generator: of every random choice after the start.
        skipped_in_a_row: steps skipped since the last good one, because of a value that was not
            finite; on the model's device.
    """

    step: int
    model: Model
    terms: tuple[Term, ...]
    image_model: ImageModel
    gaussian_optimizer: GaussianOptimizer
    layer_optimizer: Adam
    strategy: Strategy
    strategy_state: StrategyState
    sampler: ViewSampler
    generator: torch.Generator
    skipped_in_a_row: Int64[Tensor, ""]

    @classmethod
    def around(
        cls,
        model: Model,
        terms: tuple[Term, ...],
        strategy: Strategy,
        config: TrainConfig,
        capture: Capture,
        generator: torch.Generator,
    ) -> TrainingState:
        """A state at step 0: fresh optimizers around a model, on its device."""
        device = model.gaussians.means.device
        gaussian_optimizer = GaussianOptimizer(model.gaussians, config.optimizer, capture.extent)
        model.gaussians = gaussian_optimizer.gaussians
        image_model = ImageModel(config.image_model, capture).to(device)
        groups = [
            ParameterGroup(list(term.learned.to(device).parameters()), term.learning_rate)
            for term in terms
            if term.learned is not None
        ]
        groups.append(ParameterGroup(list(model.field.parameters()), config.optimizer.heads))
        return cls(
            step=0,
            model=model,
            terms=terms,
            image_model=image_model,
            gaussian_optimizer=gaussian_optimizer,
            layer_optimizer=Adam(groups + image_model.parameter_groups()),
            strategy=strategy,
            strategy_state=strategy.initial_state(model.gaussians),
            sampler=ViewSampler(capture.views, generator, config.batch),
            generator=generator,
            skipped_in_a_row=torch.zeros((), dtype=torch.int64, device=device),
        )

    @property
    def device(self) -> torch.device:
        """Device of model and optimizers; the views' order and the generator are on the host."""
        return self.model.gaussians.means.device

    def parameters(self) -> list[Tensor]:
        """All that the optimizers move, those of the Gaussians first."""
        gaussians = self.gaussian_optimizer.gaussians.tensors().values()
        return [*gaussians, *self.layer_optimizer.parameters()]

    def refresh_neighbours(self, config: TrainConfig) -> None:
        """Search the neighbours (Eq. 11) when N has changed, and every ``neighbours_every`` steps
        because Gaussians move; but not so close to the end that the layers could no longer follow.
        NotFiniteError if a position is not finite."""
        every = config.neighbours_every
        due = self.step % every == 0 and self.step + every <= config.max_steps
        if config.field.neighbours_k == 0 or not (self.model.neighbours is None or due):
            return
        means = self.model.gaussians.means
        if not means.isfinite().all():
            raise NotFiniteError(
                f"gaussians.means holds values that are not finite at step {self.step}"
            )
        self.model.neighbours = self.model.field.neighbours_of(means)

    def scale_gradients(self, factor: float) -> None:
        """Multiply all gradients by a factor."""
        if factor == 1:
            return
        layers = [layer.grad for layer in self.layer_optimizer.parameters()]
        for gradient in [*self.gaussian_optimizer.gradients(), *layers]:
            if gradient is not None:
                gradient.mul_(factor)

    def gradients_are_finite(self, loss: Tensor) -> Bool[Tensor, ""]:
        """Whether loss and gradients are finite; on the device."""
        layers = [layer.grad for layer in self.layer_optimizer.parameters()]
        present = [gradient for gradient in layers if gradient is not None]
        return are_finite(loss, self.gaussian_optimizer.gradients() + present)

    def move(self, config: TrainConfig, finite: Bool[Tensor, ""]) -> None:
        """Adam's step of all parameters, within limits; none where ``finite`` is False."""
        progress = self.step / config.max_steps
        if (movable := self.strategy.movable(self.model.gaussians)) is not None:
            self.gaussian_optimizer.hold(~movable)
        self.gaussian_optimizer.step(progress, finite)
        self.layer_optimizer.set_rates(config.optimizer.slowdown_at(progress))
        self.layer_optimizer.step(finite)
        self.layer_optimizer.zero_grad()
        self.image_model.limit()

    def go_back(self, step: int, generator: Tensor, waiting: Tensor) -> None:
        """Undo a step that failed before it moved anything, by its number and the states of the
        generator and the sampler before it."""
        self.step = step
        self.generator.set_state(generator)
        self.sampler.load(waiting)
        self.gaussian_optimizer.zero_grad()
        self.layer_optimizer.zero_grad()


def initial_state(
    scene: Scene,
    config: TrainConfig,
    device: torch.device = HOST,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
) -> TrainingState:
    """The state at step 0, from the scene's start points, made on the CPU for every device. Random
    choices follow from the seed, not torch's generators. Density control is the configuration's,
    unless a strategy is given; the terms are added to the configuration's."""
    capture = Capture.of(scene)
    strategy = config.densification if strategy is None else strategy
    apart = blended_apart(scene.modalities, config.shares_opacity)
    cameras = ImageModel(config.image_model, capture)
    find_from_overlap(scene, cameras, config.image_model)
    generator = torch.Generator().manual_seed(config.seed)
    with seeded(config.seed):
        field = RadianceField(config.field)
        all_terms = configured_terms(config, terms, model_modalities(scene.modalities))
        field.set_frame(scene.points.positions)
        shown = without_camera(scene, cameras)
        points = start_points(shown, config).at_most(strategy.max_gaussians, generator)
        degree = config.temperature_sh_degree_of(capture)
        gaussians = initial_gaussians(points, field, apart, degree)
        steps = config.fitted_residuals
        fit_residuals(field, gaussians, points.values[THERMAL], steps, generator)
    model = Model(
        gaussians,
        field,
        neighbours=None,
        sh_degree=0,
        dilation=config.dilation_of(capture),
        radiance=config.radiance_of(capture),
    ).to(device)
    state = TrainingState.around(model, all_terms, strategy, config, capture, generator)
    state.image_model.load_state_dict(cameras.state_dict())
    if state.image_model.poses is not None:
        state.image_model.poses.set_frame(scene.train_cameras, scene.points.positions)
    return state


def learned_layers(terms: Sequence[Term]) -> dict[str, nn.Module]:
    """The learned layers of the terms of a loss, by the terms' names."""
    return {term.name: term.learned for term in terms if term.learned is not None}
