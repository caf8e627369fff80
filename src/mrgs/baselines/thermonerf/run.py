"""A trained ThermoNeRF: its checkpoints, and a run opened to be rendered from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mrgs.baselines.thermonerf.config import ThermoNerfConfig, from_yaml
from mrgs.baselines.thermonerf.model import ThermoNerf
from mrgs.baselines.thermonerf.pixels import MODALITIES
from mrgs.baselines.thermonerf.rays import SceneFrame
from mrgs.baselines.thermonerf.step import NerfState, make_state, new_model
from mrgs.errors import DeviceError
from mrgs.run_files.checkpoint import (
    below,
    fitting,
    read,
    require_like,
    skipped_in_a_row_of,
    write_file,
)
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.runs.trained_run import TrainedRun
from mrgs.scene import Camera, Modality, Rendering
from mrgs.system.gpu import DeviceName
from mrgs.system.operation import checking


def tensors_of(state: NerfState) -> dict[str, Tensor]:
    """All tensors of a training, by name."""
    frame = state.model.frame
    tensors = {f"model.{name}": tensor for name, tensor in state.model.state_dict().items()}
    moments = state.optimizer.moments(dict(state.model.named_parameters()))
    tensors |= {f"adam.{name}": tensor for name, tensor in moments.items()}
    tensors["generator"] = state.generator.get_state()
    tensors["frame.centre"] = frame.centre
    tensors["frame.sizes"] = torch.tensor(
        [frame.radius, frame.near, frame.middle, frame.far], dtype=torch.float64
    )
    return tensors


def save(path: Path, state: NerfState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly, in one file that is either whole or not there.

    Raises:
        NotFiniteError: the state holds a NaN or an infinity; nothing is written.
        RunError: the file cannot be written.
    """
    header = {**facts.to_json(), "skipped_in_a_row": state.skipped_in_a_row}
    write_file(path, tensors_of(state), header)


def load_model(path: Path, config: ThermoNerfConfig) -> tuple[ThermoNerf, CheckpointFacts]:
    """The model of a checkpoint, to render with.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, or not of this configuration.
    """
    tensors, facts, _ = read(path)
    with fitting(path):
        return _model(tensors, config), facts


def load_state(path: Path, config: ThermoNerfConfig) -> NerfState:
    """Everything in a checkpoint, to train on.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, or not of this configuration.
    """
    tensors, facts, header = read(path)
    with fitting(path):
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = make_state(_model(tensors, config), config, generator)
        parameters = dict(state.model.named_parameters())
        state.optimizer.load_moments(parameters, below(tensors, "adam."))
        state.step, state.skipped_in_a_row = facts.step, skipped_in_a_row_of(header)
        require_like(tensors, tensors_of(state))
    return state


def _model(tensors: Mapping[str, Tensor], config: ThermoNerfConfig) -> ThermoNerf:
    """The model of a checkpoint.

    Raises:
        KeyError, ValueError: the tensors are not those of a model of this configuration.
    """
    frame = below(tensors, "frame.")
    numbers = {"centre": (3,), "sizes": (4,)}
    require_like(
        frame,
        {name: torch.empty(shape, dtype=torch.float64) for name, shape in numbers.items()},
    )
    radius, near, middle, far = frame["sizes"].tolist()
    if not (0 < radius < math.inf and 0 <= near < far < math.inf and 0 < middle < math.inf):
        raise ValueError("the frame has no size")
    model = new_model(config, SceneFrame(frame["centre"], radius, near, middle, far))
    layers = below(tensors, "model.")
    require_like(layers, model.state_dict())
    model.load_state_dict(layers)
    return model


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
    config = folder.read_whole_config(from_yaml)
    model, facts = folder.load_newest(lambda file: load_model(file, config))
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
