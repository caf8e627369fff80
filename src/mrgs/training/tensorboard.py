"""The log of a run for TensorBoard, beside log.jsonl."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mrgs.errors import ConfigError
from mrgs.training.run_folder import RunFolder

FOLDER = "tensorboard"
"""Below the run's folder."""


@contextmanager
def tensorboard_log(folder: RunFolder, step: int) -> Iterator[None]:
    """Within this block, write the numbers of the run's log as scalars into its folder
    ``tensorboard``.

    Args:
        folder: of the run.
        step: that training continues from; TensorBoard hides what an earlier part wrote behind it.

    Raises:
        ConfigError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        raise ConfigError(
            "TensorBoard is not installed: run `pip install 'mrgs[tensorboard]'`",
            options=("tensorboard",),
        ) from None

    with SummaryWriter(str(folder.path / FOLDER), purge_step=step + 1) as writer:

        def add(entry: Mapping[str, Any]) -> None:
            for name, value in entry.items():
                if name != "step" and isinstance(value, int | float):
                    writer.add_scalar(scalar_name(name), value, entry["step"])

        with folder.log_mirrored(add):
            yield


def scalar_name(name: str) -> str:
    """Terms of the loss in one group: ``loss_rgb`` is ``loss/rgb``."""
    return name.replace("loss_", "loss/", 1) if name.startswith("loss_") else name
