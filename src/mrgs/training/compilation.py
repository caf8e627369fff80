"""On the first run of a machine two processes share the compiling of the kernels, and it can be
asked how far they are."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch

from mrgs.method.config import TrainConfig
from mrgs.system.child import Child
from mrgs.system.strict_yaml import write_yaml

CHILD = ("-m", "mrgs.training.compile_child")

_RASTERIZER = {
    "rasterize.cpu.projection.project": 2.0,
    "rasterize.cpu.projection.project_backward": 1.9,
    "rasterize.cpu.tiles._count": 1.1,
    "rasterize.cpu.tiles.depth_order": 0.6,
    "rasterize.cpu.tiles._fill": 0.6,
    "rasterize.cpu.tiles._gather": 0.4,
    "rasterize.cpu.blend.blend": 3.0,
    "rasterize.cpu.blend_backward.blend_backward": 2.9,
}
_HARMONICS = {"harmonics.cpu._forward": 1.2, "harmonics.cpu._backward": 1.3}
_COLOR_HEAD = {"color_head._forward": 2.6, "color_head._backward": 4.2}
_THERMAL_HEAD = {"heat.thermal_head._forward": 4.1, "heat.thermal_head._backward": 5.4}
_EXCHANGE = {
    "heat.exchange._forward": 0.5,
    "heat.exchange._with_neighbours": 0.6,
    "heat.exchange._backward_anchors": 0.4,
    "heat.exchange._backward_neighbours": 0.6,
}
_COMPARISON = {"ssim.cpu._compare": 5.7}
_SMOOTHNESS = {"variation.cpu.sum_differences": 1.8}
_BLUR = {"blur.cpu.filter_plane": 1.0}
_CONVOLUTION = {
    "convolution.correlate": 0.7,
    "convolution.weights_gradient": 0.6,
}
"""The compiled functions, and the processor seconds that each takes on a core of 3 GHz."""


class CompilingProgress(NamedTuple):
    """How far the compiling is.

    Attributes:
        done: kernels that are compiled.
        total: kernels that a training needs.
        seconds_left: processor seconds for the others, on a core of 3 GHz.
    """

    done: int
    total: int
    seconds_left: float


def compiling_progress(
    config: TrainConfig, is_saved: Callable[[str], bool] | None = None
) -> CompilingProgress:
    """How many of the CPU kernels of a training lie compiled on disk."""
    needed = _needed(config)
    missing = [name for name in needed if not (is_saved or _is_saved)(name)]
    return CompilingProgress(
        len(needed) - len(missing), len(needed), sum(map(needed.__getitem__, missing))
    )


@contextmanager
def shared_compiling(
    config: TrainConfig,
    progress: Callable[[TrainConfig], CompilingProgress] = compiling_progress,
    start: Callable[..., Child] = Child,
) -> Iterator[None]:
    """Within this block, which trains on the CPU, another process compiles what this one needs
    last, if anything is missing and there is a thread for it. What fails there is compiled here."""
    if torch.get_num_threads() < 2 or progress(config).seconds_left == 0:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="mrgs-") as folder:
        child = start(CHILD, {"config": write_yaml(config)}, Path(folder, "stderr.txt"))
        try:
            yield
        finally:
            child.close()


class Countdown:
    """Says what is left of the compiling, by the pace at which it goes.

    Args:
        config: of the training.
        progress: how far it is.
        clock: in seconds.
    """

    def __init__(
        self,
        config: TrainConfig,
        progress: Callable[[TrainConfig], CompilingProgress] = compiling_progress,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._progress, self._clock = config, progress, clock
        self._at_first = progress(config)
        self._started = clock()

    @property
    def text(self) -> str | None:
        """One line; None if nothing is left to compile."""
        now = self._progress(self._config)
        if now.done == now.total:
            return None
        made = self._at_first.seconds_left - now.seconds_left
        # Before the first is done, as fast as two such cores.
        pace = (made + 2.0) / (self._clock() - self._started + 1.0)
        left = max(1, round(now.seconds_left / pace))
        return f"compiling kernels {now.done}/{now.total}, about {left} s left"


def _needed(config: TrainConfig) -> dict[str, float]:
    """The kernels of a training by name, with their seconds."""
    field, loss = config.field, config.loss
    needed = _RASTERIZER | _HARMONICS | _COMPARISON
    if field.residuals:
        needed |= _COLOR_HEAD | _THERMAL_HEAD | (_EXCHANGE if field.neighbours_k > 0 else {})
    parts = (loss.smooth_rgb, loss.smooth_thermal, loss.smooth_alike, loss.smooth_depth)
    if loss.smooth > 0 and (max(parts) > 0 or loss.smooth_noise is not None):
        needed |= _SMOOTHNESS
    if config.image_model.point_spread:
        needed |= _BLUR
    if config.radiation is not None:
        needed |= _CONVOLUTION
    return needed


def _is_saved(name: str) -> bool:
    """Whether a kernel lies compiled on disk, or is not compiled at all (NUMBA_DISABLE_JIT)."""
    from numba.extending import is_jitted

    module, _, function = name.rpartition(".")
    dispatcher: Any = getattr(import_module(f"mrgs.kernels.{module}"), function)
    return dispatcher._cache.is_saved if is_jitted(dispatcher) else True
