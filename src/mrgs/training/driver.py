"""The training loop of any method: steps, log and checkpoints."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from mrgs.errors import NotFiniteError, RunError, TrainingError
from mrgs.scene import TemperatureRange
from mrgs.system import gpu
from mrgs.system.gpu import HOST
from mrgs.system.threads import require_own_threads
from mrgs.system.torch_modes import own_modes
from mrgs.system.turns import FairLock, ctrl_c_waits
from mrgs.training.checkpoint_file import first_not_finite
from mrgs.training.facts import CheckpointFacts
from mrgs.training.memory import peak_memory_bytes
from mrgs.training.run_folder import RunFolder

LOG_EVERY = 10
LOG_MODEL_EVERY = 100
CHECK_MODEL_EVERY = 100
CHECK_EVERY = {"cpu": 1, "cuda": LOG_EVERY}
"""Steps after which the driver checks whether some were skipped; on a GPU the host waits for
that."""

MAX_SKIPPED_IN_A_ROW = 3

SAVE_EVERY_S = 120.0
"""Most seconds between checkpoints: so much is lost of a training whose process is killed."""

SAVE_SHARE = 0.02
"""Checkpoints that are written before their turn take no more than this share of the time."""


@runtime_checkable
class Statistics(Protocol):
    """The measurements of one training step, of any method."""

    @property
    def step(self) -> int:
        """Number of the step, from 1."""

    @property
    def loss(self) -> float:
        """L_total of the step; not finite if the step was skipped."""

    @property
    def terms(self) -> Mapping[str, float]:
        """Unweighted terms of the loss, by name."""

    @property
    def thermal_error(self) -> float | None:
        """Mean absolute error of the normalised temperature."""

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians; None for a method without Gaussians."""

    @property
    def skipped(self) -> bool:
        """Whether the step changed nothing, because a value was not finite."""


S = TypeVar("S", bound=Statistics)


class Driver(ABC, Generic[S]):
    """Steps, logs, checkpoints; a method says what a step does and what a checkpoint holds.

    Args:
        folder: the run's folder, which the caller has locked.
        facts: of the checkpoint that is continued, or of step 0.
        max_steps: of the schedule.
        checkpoint_every: steps between checkpoints; where that takes long, there are more.
        device: where the steps are done.
        check_every: steps between looks for skipped ones; those of the device if None.
        clock: in seconds.
    """

    def __init__(
        self,
        folder: RunFolder,
        facts: CheckpointFacts,
        max_steps: int,
        checkpoint_every: int,
        device: torch.device = HOST,
        check_every: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._folder = folder
        self._facts = facts
        self._max_steps = max_steps
        self._checkpoint_every = checkpoint_every
        self._device = device
        self._check_every = check_every or CHECK_EVERY[device.type]
        self._clock = clock
        self._unchecked: list[S] = []
        self._bad_in_a_row = self._skipped_in_a_row
        self._step_done = facts.step
        self._is_half_done = False
        self._is_closed = False
        self._turns = FairLock()
        self._skipped_steps = facts.skipped_steps
        self._started = clock()
        self._save_at = self._started + SAVE_EVERY_S

    @abstractmethod
    def _take_step(self) -> S:
        """Take the next training step."""

    @property
    @abstractmethod
    def _skipped_in_a_row(self) -> int:
        """Steps that the state says were skipped since the last good one."""

    def _describe_model(self) -> Mapping[str, float | None]:
        """What the log says of the model every ``LOG_MODEL_EVERY`` steps."""
        return {}

    @abstractmethod
    def _tensors(self) -> Mapping[str, Tensor]:
        """All tensors of the state, by name."""

    @abstractmethod
    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        """Write everything needed to resume exactly."""

    def run(self, stop_at: int | None, on_step: Callable[[S], object] | None) -> None:
        """Step until the end of the schedule, or until ``on_step`` returns True; the last step is
        checkpointed, also where Ctrl-C or an error in ``on_step`` ends the training."""
        last = self._max_steps if stop_at is None else min(stop_at, self._max_steps)
        while self._step_done < last:
            with self._kept():
                statistics = self._next_step()
                if on_step is not None and _is_true(on_step(statistics)):
                    last = self._step_done
            self._save_if_due(last)

    def steps(self) -> Generator[S, None, None]:
        """Step until the end of the schedule, or until closed; the last step is checkpointed, also
        where Ctrl-C ends the training."""
        while self._step_done < self._max_steps:
            with self._kept():
                yield self._next_step()
            self._save_if_due(self._max_steps)

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """Whatever leaves this block early, the last step is checkpointed; unless it is the step
        itself that failed."""
        try:
            yield
        except BaseException:
            if not self._is_half_done:
                self.save()
            raise

    def close(self) -> None:
        """No checkpoint is written any more: the run's folder may be another training's."""
        with self.between_steps():
            self._is_closed = True

    def between_steps(self) -> AbstractContextManager[None]:
        """Within this block no other thread takes a step or writes a checkpoint."""
        return self._turns.taken()

    @property
    def is_awaited(self) -> bool:
        """Whether a thread waits for the end of what is under way."""
        return self._turns.is_awaited

    def _next_step(self) -> S:
        """Take a whole step; Ctrl-C waits for its end."""
        require_own_threads()
        with ctrl_c_waits(), self.between_steps(), own_modes(self._device):
            self._is_half_done = True
            statistics = self._take_logged_step()
            self._is_half_done = False
        return statistics

    def _take_logged_step(self) -> S:
        """Take a step, and log it if its turn has come."""
        try:
            statistics = self._take_step()
        except NotFiniteError as error:
            raise self._stopped(str(error), NotFiniteError) from error
        self._step_done = statistics.step
        self._unchecked.append(statistics)
        if self._step_done % self._check_every == 0:
            self._note_skipped_steps()
        if self._step_done % CHECK_MODEL_EVERY == 0:
            self._require_finite_model()
        if self._step_done % LOG_EVERY == 0 or self._step_done == self._max_steps:
            self._log(statistics)
        return statistics

    def _note_skipped_steps(self) -> None:
        """Log and count the steps that were skipped since the last call."""
        unchecked, self._unchecked = self._unchecked, []
        for statistics in unchecked:
            self._bad_in_a_row = self._bad_in_a_row + 1 if statistics.skipped else 0
            if statistics.skipped:
                self._note_skipped(statistics)

    def _note_skipped(self, statistics: S) -> None:
        self._skipped_steps += 1
        self._folder.append_log(
            {"step": statistics.step, "skipped": "the loss or a gradient was not finite"}
        )
        if self._bad_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise self._stopped(
                f"{MAX_SKIPPED_IN_A_ROW} steps in a row gave values that are not finite, at step "
                f"{statistics.step}"
            )

    def _require_finite_model(self) -> None:
        """Gradients that are not finite move nothing; but what has come into the model in another
        way would stay.

        Raises:
            NotFiniteError: the state holds a NaN or an infinity.
        """
        if (name := first_not_finite(self._tensors())) is not None:
            raise self._stopped(
                f"{name} holds values that are not finite after step {self._step_done}",
                NotFiniteError,
            )

    def _stopped(self, why: str, kind: type[TrainingError] = TrainingError) -> TrainingError:
        """The error for values that are not finite, with what is left."""
        found = self._folder.checkpoints()
        kept = f"the last good checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
        again = "Resume" if found else "Retrain"
        return kind(
            f"{why}; {kept}. {again} with a smaller learning rate, or check the scene's poses and "
            f"images"
        )

    def _log(self, statistics: S) -> None:
        entry: dict[str, float | None] = {"step": statistics.step}
        if not statistics.skipped:
            entry["loss"] = statistics.loss
            entry |= {f"loss_{name}": value for name, value in statistics.terms.items()}
            entry["thermal_error_c"] = _celsius(statistics.thermal_error, self._facts.temperature)
        if statistics.gaussians is not None:
            entry["gaussians"] = statistics.gaussians
        if self._step_done % LOG_MODEL_EVERY == 0 or self._step_done == self._max_steps:
            entry |= self._describe_model()
        self._folder.append_log({**entry, "seconds": self._seconds()})

    def _seconds(self) -> float:
        return self._facts.train_seconds + self._clock() - self._started

    def _peak_memory_bytes(self) -> int:
        """Of this process, or of one before it if the run was on this device there too."""
        is_same = self._facts.device == gpu.device_title(self._device)
        return max(self._facts.peak_memory_bytes if is_same else 0, peak_memory_bytes(self._device))

    def _save_if_due(self, last: int) -> None:
        """Write a checkpoint after a step whose turn it is, after the last one, and where the
        others lie too far back."""
        its_turn = self._step_done % self._checkpoint_every == 0 or self._step_done == last
        if its_turn or self._clock() >= self._save_at:
            self.save()

    def save(self) -> None:
        """Write a checkpoint of the last step; Ctrl-C waits for its end.

        Raises:
            NotFiniteError: the state holds a NaN or an infinity.
            TrainingError: the step was interrupted half-way.
            RunError: the training has ended, or the checkpoint cannot be written.
            MrgsError: this process was forked from the one that trains.
        """
        require_own_threads()
        with ctrl_c_waits(), self.between_steps():
            if self._is_closed:
                path = str(self._folder.path)
                raise RunError(f"the training has ended: open the run with load_run({path!r})")
            if self._is_half_done:
                raise TrainingError(
                    f"step {self._step_done + 1} was interrupted half-way and cannot be saved: "
                    f"resume from the last checkpoint"
                )
            self._save()

    def _save(self) -> None:
        began = self._clock()
        self._note_skipped_steps()
        self._require_finite_model()
        facts = self._facts._replace(
            step=self._step_done,
            train_seconds=self._seconds(),
            peak_memory_bytes=self._peak_memory_bytes(),
            skipped_steps=self._skipped_steps,
            device=gpu.device_title(self._device),
        )
        self._write_checkpoint(self._folder.checkpoint_file(self._step_done), facts)
        self._folder.drop_old_checkpoints()
        now = self._clock()
        self._save_at = now + max(SAVE_EVERY_S, (now - began) / SAVE_SHARE)


def _is_true(answer: object) -> bool:
    """Whether the answer of ``on_step`` is True itself, of any library; a number of characters
    written, or a list, stops nothing."""
    if isinstance(answer, Tensor):
        return answer.dtype == torch.bool and answer.ndim == 0 and bool(answer)
    return isinstance(answer, (bool, np.bool_)) and bool(answer)


def _celsius(difference: float | None, temperature: TemperatureRange | None) -> float | None:
    return None if difference is None or temperature is None else difference * temperature.span_c
