"""A trained ThermoNeRF, opened to be rendered from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from mrgs.baselines.thermonerf.checkpoint import load_model
from mrgs.baselines.thermonerf.config import ThermoNerfConfig, from_yaml
from mrgs.baselines.thermonerf.frame import SceneFrame
from mrgs.baselines.thermonerf.model import ThermoNerf
from mrgs.baselines.thermonerf.pixels import MODALITIES
from mrgs.errors import DeviceError
from mrgs.scene import Camera, Modality, Rendering
from mrgs.system.gpu import DeviceName
from mrgs.system.operation import checking
from mrgs.training.newest import load_newest
from mrgs.training.run_folder import RunFolder
from mrgs.training.trained_run import TrainedRun


@dataclass(frozen=True, eq=False)
class ThermoNerfRun(TrainedRun):
    """A run that can be rendered and scored, but has no Gaussians.

    Attributes:
        model: what it learned.
    """

    config: ThermoNerfConfig
    model: ThermoNerf

    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:  # noqa: D102
        return self.model.render(cameras)

    @property
    def modalities(self) -> tuple[Modality, ...]:  # noqa: D102
        return MODALITIES

    @property
    def gaussian_count(self) -> None:  # noqa: D102
        return None


def open_thermonerf(
    path: str | Path, scene: str | Path | None = None, device: DeviceName = "auto"
) -> ThermoNerfRun:
    """Open the newest checkpoint of a ThermoNeRF run, which renders on the CPU; an older one if it
    is damaged.

    Args:
        path: the run's folder.
        scene: the scene's folder, if it has moved since training.
        device: "auto" or "cpu".

    Warns:
        MrgsWarning: an older checkpoint is used, or a kernel that rendering uses differs from the
            plain definition of its operation, which is then used in its place.

    Raises:
        RunError: the folder is not a run, or its checkpoint cannot be used.
        DeviceError: the GPU was asked for.
    """
    require_cpu(device)
    folder = RunFolder(path)
    folder.newest_checkpoint()
    config = folder.read_config(from_yaml)
    folder.warn_if_incomplete(config)
    model, facts = load_newest(folder, lambda file: load_model(file, config))
    with checking(gradients=False):
        model.render(dict.fromkeys(MODALITIES, _small_camera(model.frame)))
    return ThermoNerfRun(folder, config, facts.moved_to(scene), model)


def _small_camera(frame: SceneFrame) -> Camera:
    """A camera in the middle of the scene, of a few rays: enough to compare kernels."""
    K = torch.tensor([[4.0, 0, 4.0], [0, 4.0, 2.0], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -frame.centre
    return Camera(K, viewmat, 8, 4)


def require_cpu(device: DeviceName) -> None:
    """There are no kernels for a GPU.

    Raises:
        DeviceError: the GPU was asked for.
    """
    if device == "cuda":
        raise DeviceError("thermonerf works on the CPU alone")
