"""The step on a GPU: the same numbers as on the CPU, and no waiting for the device.

Without one, kernels are interpreted on CPU tensors, and what the host of a real GPU would wait for
is an error.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from mrgs import render as render_module
from mrgs.data import load_scene
from mrgs.field import nearest_neighbours
from mrgs.method.camera_model.image_model import ImageModelConfig
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.rasterizer import Raster
from mrgs.scene import RGB, Blend, Pixels
from mrgs.scene.arrays import constant
from mrgs.system import gpu
from mrgs.system.cuda_graph import sync_debug_mode
from mrgs.training import step as step_module
from mrgs.training.state import initial_state
from mrgs.training.step import control_density, training_step
from mrgs.training.view_pass import PhotographedView
from tests.helpers.training import short_config, tensors_of

aten = torch.ops.aten

WAITED_FOR = {
    aten._local_scalar_dense, aten.nonzero, aten.masked_select, aten.repeat_interleave,
    aten.bincount, aten.unique_dim,
    aten._unique, aten._unique2, aten.unique_consecutive,
}  # fmt: skip
"""What reads numbers or sizes from the device: ``item``, ``bool``, ``float`` and the like all end
in the first."""


INDEXING = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
MASKS = {torch.bool, torch.uint8}


class RoundTripError(Exception):
    """The host would wait for the device."""


class NoRoundTrips(TorchDispatchMode):
    """Every tensor counts as one on a device, but for constants and cameras, which are of
    float64."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        packet = func.overloadpacket
        if packet in WAITED_FOR and func is not aten.repeat_interleave.self_int:
            raise RoundTripError(f"{func} reads from the device")
        if packet in INDEXING and any(
            place is not None and place.dtype in MASKS for place in args[1]
        ):
            raise RoundTripError(f"{func} counts the places of a mask")
        if packet is aten.lift_fresh or (packet is aten._to_copy and _is_a_camera(args[0])):
            raise RoundTripError(f"{func} copies from the host")
        if packet is aten.equal and args[0].dtype != torch.float64:
            raise RoundTripError(f"{func} compares on the device, and asks")
        return func(*args, **(kwargs or {}))


def _is_a_camera(tensor: torch.Tensor) -> bool:
    """A matrix or a vector in double precision; the sums of the losses are single numbers."""
    return tensor.dtype == torch.float64 and tensor.ndim > 0


class NoReading(TorchFunctionMode):
    """What reads a tensor without asking torch's dispatcher is an error too."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in {"numpy", "tolist", "cpu", "__array__"} and args[0].dtype != torch.float64:
            raise RoundTripError(f"Tensor.{name} reads from the device")
        return func(*args, **(kwargs or {}))


@contextmanager
def no_round_trips() -> Iterator[None]:
    """Within this block."""
    with NoReading(), NoRoundTrips():
        yield


def flat_raster(geometry, layers, projection, offset) -> Raster:
    """Stands in for the rasterizer, which may read one number: images that depend on every
    parameter."""
    size, device = (projection.height, projection.width), geometry.means.device
    ramp = torch.linspace(0.5, 1, size[0] * size[1], device=device).view(size)
    turn = sum(0.01 * tensor.square().mean() for tensor in (*geometry, offset + 1))
    blends = []
    for layer in layers:
        value = (layer.opacities[:, None] * layer.features).mean(dim=0)
        shade = ramp * (1 + turn)
        blends.append(Blend(shade[..., None] * value, shade * 3, shade * layer.opacities.mean()))
    return Raster(tuple(blends), torch.ones(len(geometry.means), device=device))


flat_raster.kernel, flat_raster.rejected = lambda inputs: flat_raster, frozenset()


@pytest.fixture
def stop_kernels(gpu_device: str, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From this call on kernels are not run, so that numbers mean nothing: a GPU's host does not
    see them either."""
    if gpu_device != "cpu":
        pytest.skip("where there is a GPU, it is asked")
    from triton.runtime.interpreter import GridExecutor

    def stop() -> None:
        monkeypatch.setattr(GridExecutor, "__call__", lambda *args, **options: None)
        monkeypatch.setattr(render_module, "rasterize", flat_raster)

    return stop


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """There all Gaussians count as seen: CPU tensors that stand for those of a GPU must not tell
    themselves."""
    on_cpu = render_module.rows_in_view

    def rows_in_view(*args: Any) -> Any:
        return None if gpu.runs_triton(torch.empty(0)) else on_cpu(*args)

    monkeypatch.setattr(render_module, "rows_in_view", rows_in_view)


def harmonic(config: TrainConfig) -> TrainConfig:
    """As in scenes without °C, where ``mrgs-plus`` has harmonics of the temperature too."""
    return (
        replace(config, temperature_sh_degree=3) if config.temperature_sh_degree is None else config
    )


@pytest.fixture
def start(small_scene):
    """Ten Gaussians, images of 8×6, and a step on them; the neighbours are known, and the first
    camera is copied."""

    def make(method: str, terms: Sequence[Term] = (), **changes: Any):
        config = harmonic(short_config(method, sh_every=1, **changes))
        config = replace(config, densification=replace(config.densification, max_gaussians=10))
        scene = load_scene(small_scene, resolution=8)
        state = initial_state(scene, config, terms=terms)
        with (
            torch.no_grad()
        ):  # balls have no gradient by their rotation but noise, and Adam would follow it
            state.model.gaussians.log_scales += torch.tensor([0.0, 0.4, -0.4])
        scale = SceneScale(scene.extent, scene.temperature)
        if config.field.neighbours_k > 0:
            state.model.neighbours = nearest_neighbours(
                state.model.gaussians.means.double(), config.field.neighbours_k
            )
        for dtype in (torch.float32, torch.float64):
            scene.train[0].images[RGB].camera.tensors(gpu.HOST, dtype)
        constant((4.0, 3.0), torch.zeros(1))

        def take(number: int = 0, masked: bool = False):
            view = scene.train[number]
            photos = {modality: image.load() for modality, image in view.images.items()}
            if masked:
                valid = torch.ones(6, 8, dtype=torch.bool)
                valid[2:4, 1:5] = False
                photos = {each: replace(pixels, valid=valid) for each, pixels in photos.items()}

            def step() -> step_module.StepStatistics:
                result = training_step(
                    state, [PhotographedView(number, view, photos)], config, scale
                )
                control_density(state, result, config, scale.extent)
                return result.statistics

            return step

        return state, take

    return make


EVERY_PART = ImageModelConfig(radiance=True, point_spread=True, thermal_gain=True)
METHODS = ["mrgs", "mrgs-plus", "3dgs-rgbt"]


@pytest.mark.parametrize(
    ("method", "masked"),
    [("mrgs", False), ("mrgs-plus", False), ("3dgs-rgbt", False), ("3dgs-rgbt", True)],
)
def test_a_step_waits_for_nothing(method, masked, start, stop_kernels):
    _, take = start(method, image_model=EVERY_PART)
    steps = [take(0, masked), take(0, masked)]
    stop_kernels()
    with no_round_trips():
        statistics = [step() for step in steps]
    assert [each.step for each in statistics] == [1, 2]


@pytest.mark.gpu
@pytest.mark.parametrize("method", METHODS)
def test_a_step_on_a_gpu_waits_for_one_number_of_each_pass(method, small_scene):
    """The length of the rasterizer's list, and nothing else."""
    device = torch.device("cuda")
    config = harmonic(short_config(method, sh_every=1))
    scene = load_scene(small_scene)
    state = initial_state(scene, config, device)
    view = scene.train[0]
    photos = {
        modality: Pixels(image.load().values.to(device)) for modality, image in view.images.items()
    }
    scale = SceneScale(scene.extent, scene.temperature)

    def take() -> None:
        result = training_step(state, [PhotographedView(0, view, photos)], config, scale)
        control_density(state, result, config, scale.extent)

    for _ in range(2):
        take()
    with (
        sync_debug_mode("warn"),
        pytest.warns(UserWarning, match="called a synchronizing") as caught,
    ):
        take()
    assert len([each for each in caught if "called a synchronizing" in str(each.message)]) == 1


READERS: list[Callable[[torch.Tensor], Any]] = [
    lambda loss: loss.item(),
    lambda loss: bool(loss > 0),
    lambda loss: float(loss),
    lambda loss: loss.detach().numpy(),
    lambda loss: loss.tolist(),
    lambda loss: loss[loss > 0],
    lambda loss: torch.tensor(1.0),
    lambda loss: loss.new_tensor([1.0]),
    lambda loss: loss.nonzero(),
]


class Reads(Term):
    """Has nothing to say, and reads a number."""

    name = "reads"

    def __init__(self, reader: Callable[[torch.Tensor], Any]) -> None:
        self._reader = reader

    def value(self, context: LossContext) -> None:
        self._reader(context.observed[RGB].image.mean().detach())


@pytest.mark.parametrize("reader", READERS)
def test_the_check_can_fail(reader, start, stop_kernels):
    _, take = start("3dgs-rgbt", [Reads(reader)])
    step = take()
    stop_kernels()
    with pytest.raises(RoundTripError), no_round_trips():
        step()


@pytest.mark.parametrize("method", METHODS)
def test_all_of_a_step_is_on_one_device(method, small_scene, stop_kernels, monkeypatch):
    """Tensors without contents tell which device they are on, and refuse those of another."""

    def no_adam(*arguments: list[torch.Tensor], found_inf: torch.Tensor, **_: Any) -> None:
        """torch has no fused one for this device."""
        tensors = [found_inf, *(each for list_ in arguments for each in list_)]
        assert all(each.is_meta for each in tensors)

    stop_kernels()
    monkeypatch.setattr(gpu, "runs_triton", lambda tensor: tensor.is_meta)
    monkeypatch.setattr(torch, "_fused_adam_", no_adam)
    device = torch.device("meta")
    config = harmonic(short_config(method, sh_every=1, image_model=EVERY_PART, fitted_residuals=0))
    scene = load_scene(small_scene, resolution=8)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "for .*: copying")  # there are no contents
        state = initial_state(scene, config, device)
    if config.field.neighbours_k > 0:
        state.model.neighbours = torch.zeros(
            25, config.field.neighbours_k, dtype=torch.int64, device=device
        )
    view = scene.train[0]
    valid = torch.ones(6, 8, dtype=torch.bool, device=device)
    photos = {
        modality: Pixels(image.load().values.to(device), valid)
        for modality, image in view.images.items()
    }
    scale = SceneScale(scene.extent, scene.temperature)
    for number in (1, 2):
        result = training_step(state, [PhotographedView(0, view, photos)], config, scale)
        control_density(state, result, config, scale.extent)
        assert result.statistics.step == number
        assert result.statistics._measured.device == device
    for name, tensor in tensors_of(state).items():
        assert tensor.device == device or name.endswith(".step"), name


@pytest.mark.slow
@pytest.mark.parametrize("method", ["mrgs-plus", "3dgs-rgbt"])
def test_the_kernels_train_as_the_cpu_does(method, start):
    """Two steps with every kernel of a GPU against two with those of the CPU, all on CPU
    tensors."""
    pytest.importorskip("triton")
    if torch.cuda.is_available():
        pytest.skip("the kernels are not interpreted")
    found, by_gpu = start(method)
    found.model.neighbours = None
    expected, by_cpu = start(method)
    for tolerance in (
        1e-4,
        1e-2,
    ):  # Adam's step is as long as the rate, whatever the gradient: so noise grows
        with gpu.interpreted():
            on_gpu = by_gpu()()
        on_cpu = by_cpu()()
        if tolerance == 1e-4:
            moments_on_gpu, moments_on_cpu = tensors_of(found), tensors_of(expected)
        assert on_gpu.loss == pytest.approx(on_cpu.loss, rel=tolerance)
        assert on_gpu.terms == pytest.approx(on_cpu.terms, rel=10 * tolerance)
        assert on_gpu.thermal_error == pytest.approx(on_cpu.thermal_error, rel=tolerance)
    assert found.model.neighbours is None or torch.equal(
        found.model.neighbours, expected.model.neighbours
    )
    assert set(moments_on_gpu) == set(moments_on_cpu)
    for name, here in moments_on_cpu.items():
        if name.endswith("exp_avg") or name == "strategy.gradient_sum":
            assert (moments_on_gpu[name] - here).norm() <= 1e-3 * here.norm(), name
