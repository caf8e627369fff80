"""What a training loop of any method writes into the run's folder: log and checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.errors import NotFiniteError, TrainingError
from mrgs.run_files.checkpoint import first_not_finite
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunConfig, RunFolder
from mrgs.system import gpu
from mrgs.system.gpu import HOST
from mrgs.system.memory import peak_resident
from mrgs.system.threads import ctrl_c_waits

LOG_EVERY = 10
LOG_MODEL_EVERY = 100
CHECK_MODEL_EVERY = 100
CHECK_EVERY = {"cpu": 1, "cuda": LOG_EVERY}
"""Number of steps after which skipped ones are counted; on a GPU the host waits for that."""

MAX_SKIPPED_IN_A_ROW = 3

SAVE_EVERY_S = 120.0
"""Maximum time between checkpoints, lost if the process is killed."""

SAVE_SHARE = 0.02
"""Maximum share of the time spent on checkpoints between the scheduled ones."""


class StepStatistics:
    """The measurements of a training step of any method, counted from 1, with the number of
    Gaussians, None for a method without. On a GPU the numbers are fetched when the first of them is
    read, which waits for the GPU."""

    def __init__(
        self,
        step: int,
        loss: float | Float[Tensor, ""],
        terms: Mapping[str, float | Float[Tensor, ""]],
        thermal_error: float | Float[Tensor, ""] | None,
        gaussians: int | None,
        skipped: bool | Tensor,
    ) -> None:
        self.step, self.gaussians, self._names = step, gaussians, tuple(terms)
        error = math.nan if thermal_error is None else thermal_error
        self._measured = _as_one([loss, skipped, error, *terms.values()])

    @property
    def loss(self) -> float:
        """L_total; not finite if the step was skipped for it."""
        return self._read()[0]

    @property
    def skipped(self) -> bool:
        """Whether the loss or a gradient was not finite, so that nothing was changed."""
        return bool(self._read()[1])

    @property
    def thermal_error(self) -> float | None:
        """Mean absolute normalised temperature error on the training view; None without thermal."""
        error = self._read()[2]
        return None if math.isnan(error) else error

    @property
    def terms(self) -> dict[str, float]:
        """Every term of the loss by its name, unweighted."""
        return dict(zip(self._names, self._read()[3:], strict=True))

    def _read(self) -> list[float]:
        if isinstance(self._measured, Tensor):
            self._measured = self._measured.tolist()
        return self._measured


def _as_one(numbers: Sequence[float | Tensor]) -> Tensor | list[float]:
    """Numbers as one tensor, to be fetched at once, if any of them is a tensor."""
    like = next((number.detach() for number in numbers if isinstance(number, Tensor)), None)
    if like is None:
        return [float(number) for number in numbers]
    return torch.stack(
        [
            n.detach().to(like) if isinstance(n, Tensor) else torch.full_like(like, n)
            for n in numbers
        ]
    )


class RunRecord:
    """Log and checkpoints of a run during its training. ``step`` is the number of steps done.

    Args:
        folder: the run's folder, locked by the caller.
        facts: of the checkpoint that is resumed, or of step 0.
        tensors: returns all tensors of the training's state, by name.
        write: writes a checkpoint, from its path and facts.
        describe: returns numbers about the model for the log, every ``LOG_MODEL_EVERY`` steps.
        skipped_in_a_row: number of steps skipped since the last good one.
        check_every: steps after which skipped ones are counted; by default ``CHECK_EVERY``.
    """

    def __init__(
        self,
        folder: RunFolder,
        facts: CheckpointFacts,
        config: RunConfig,
        tensors: Callable[[], Mapping[str, Tensor]],
        write: Callable[[Path, CheckpointFacts], None],
        describe: Callable[[], Mapping[str, float | None]] = dict,
        *,
        device: torch.device = HOST,
        skipped_in_a_row: int = 0,
        check_every: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.step = facts.step
        self._folder, self._facts, self._config, self._device = folder, facts, config, device
        self._tensors, self._write, self._describe = tensors, write, describe
        self._clock, self._check_every = clock, check_every or CHECK_EVERY[device.type]
        self._unchecked: list[StepStatistics] = []
        self._bad_in_a_row = skipped_in_a_row
        self._skipped_steps = facts.skipped_steps
        self._started = clock()
        self._save_at = self._started + SAVE_EVERY_S

    def add(self, statistics: StepStatistics) -> None:
        """Count a step, and log it if it is its turn. TrainingError if three steps in a row were
        skipped, NotFiniteError if the state has a NaN or an infinity, RunError if it cannot log."""
        self.step = statistics.step
        self._unchecked.append(statistics)
        if self.step % self._check_every == 0:
            self._count_skipped()
        if self.step % CHECK_MODEL_EVERY == 0:
            self._require_finite_model()
        is_last = self.step == self._config.max_steps
        if self.step % LOG_EVERY != 0 and not is_last:
            return
        entry: dict[str, float | None] = {"step": statistics.step}
        if not statistics.skipped:
            entry["loss"] = statistics.loss
            entry |= {f"loss_{name}": value for name, value in statistics.terms.items()}
            error, temperature = statistics.thermal_error, self._facts.temperature
            if error is not None:
                error = None if temperature is None else error * temperature.span_c
            entry["thermal_error_c"] = error
        if statistics.gaussians is not None:
            entry["gaussians"] = statistics.gaussians
        if self.step % LOG_MODEL_EVERY == 0 or is_last:
            entry |= self._describe()
        self._folder.append_log({**entry, "seconds": self._seconds()})

    def save_if_due(self, last: int) -> None:
        """Write a checkpoint each ``checkpoint_every`` steps, after the last step, and if the
        newest one is too old."""
        is_scheduled = self.step % self._config.checkpoint_every == 0 or self.step == last
        if is_scheduled or self._clock() >= self._save_at:
            self.save()

    def save(self) -> None:
        """Write a checkpoint of the last step; Ctrl-C waits for its end. NotFiniteError if the
        state has a NaN or an infinity, RunError if the checkpoint cannot be written."""
        with ctrl_c_waits():
            began = self._clock()
            self._count_skipped()
            self._require_finite_model()
            device = gpu.device_title(self._device)
            earlier = self._facts.peak_memory_bytes if self._facts.device == device else 0
            facts = self._facts._replace(
                step=self.step,
                train_seconds=self._seconds(),
                peak_memory_bytes=max(earlier, peak_memory_bytes(self._device)),
                skipped_steps=self._skipped_steps,
                device=device,
            )
            self._write(self._folder.checkpoint_file(self.step), facts)
            self._folder.drop_old_checkpoints()
            now = self._clock()
            self._save_at = now + max(SAVE_EVERY_S, (now - began) / SAVE_SHARE)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Within this block nothing is trained: its time does not count as the training's."""
        began = self._clock()
        try:
            yield
        finally:
            self._started += self._clock() - began

    def error(self, why: str, kind: type[TrainingError] = TrainingError) -> TrainingError:
        """The error for values that are not finite, with the newest checkpoint."""
        found = self._folder.checkpoints()
        kept = f"the last good checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
        again = "Resume" if found else "Retrain"
        return kind(
            f"{why}; {kept}. {again} with a smaller learning rate, or check poses and images"
        )

    def _seconds(self) -> float:
        return self._facts.train_seconds + self._clock() - self._started

    def _count_skipped(self) -> None:
        """Log and count the steps that were skipped since the last call."""
        unchecked, self._unchecked = self._unchecked, []
        for statistics in unchecked:
            if not statistics.skipped:
                self._bad_in_a_row = 0
                continue
            self._bad_in_a_row += 1
            self._skipped_steps += 1
            reason = "the loss or a gradient was not finite"
            self._folder.append_log({"step": statistics.step, "skipped": reason})
            if (count := self._bad_in_a_row) >= MAX_SKIPPED_IN_A_ROW:
                at = f"at step {statistics.step}"
                raise self.error(f"{count} steps in a row gave values that are not finite, {at}")

    def _require_finite_model(self) -> None:
        """Check the state: skipped steps keep gradients that are not finite out of the model, but
        not values that got there in another way."""
        if (name := first_not_finite(self._tensors())) is not None:
            raise self.error(
                f"{name} holds values that are not finite after step {self.step}", NotFiniteError
            )


def peak_memory_bytes(device: torch.device = HOST) -> int:
    """Most memory of this process so far: a GPU's tensors, else resident; 0 if unknown."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else peak_resident()


def asks_to_stop(answer: object) -> bool:
    """Whether a hook returned True, of any library; other values, such as a number of characters
    written or a list, stop nothing."""
    if isinstance(answer, Tensor):
        return answer.dtype == torch.bool and answer.ndim == 0 and bool(answer)
    return isinstance(answer, (bool, np.bool_)) and bool(answer)
