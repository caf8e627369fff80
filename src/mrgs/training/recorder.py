"""The pass of a view as a CUDA graph: recorded once, replayed for the views that follow.

A pass is more than 500 kernels, at 50,000 Gaussians of a few microseconds each, and to start a
kernel takes the host longer than that. A replay starts them all at once (docs/decisions, 052).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from itertools import combinations
from typing import TypeAlias

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from mrgs.errors import warn_user
from mrgs.system.cuda_graph import CudaGraph, ListRoom, lists_have, sync_debug_mode
from mrgs.system.gpu import lacks_memory
from mrgs.training.photos import change_each
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import ViewInputs, ViewMeasures

Pass: TypeAlias = Callable[[ViewInputs], ViewMeasures]
"""Reads inputs and a state; leaves gradients in the state's parameters."""

SPARE = 1.25
"""Room of the lists of a recorded pass, in lengths of the longest one so far: views differ."""

MOST_RECORDINGS = 8
"""Largest number of recordings at a time; each keeps the memory of a pass. Views of more kinds than
this are not recorded."""

STALE_AFTER = 1000
"""Runs after which an unused recording makes room for another."""


class Recorder:
    """Replays the pass of a view where it can, with the results of the pass itself.

    For the first view of a kind the pass runs as it is, which shows how long the lists of the
    rasterizer are; with the second one it is recorded. Where views differ by more than poses and
    photos (in size, intrinsics, modalities), each kind has a recording. All are forgotten when the
    parameters are others: when Gaussians are added or removed. ``graph`` is what records there, and
    ``watched`` makes errors of waits for the device."""

    def __init__(
        self,
        device: torch.device,
        graph: Callable[..., CudaGraph] = CudaGraph,
        watched: Callable[..., AbstractContextManager[None]] = sync_debug_mode,
    ) -> None:
        self._device, self._graph, self._watched = device, graph, watched
        self._parameters: list[Tensor] = []
        self._neighbours: Tensor | None = None
        self._recordings: dict[Hashable, _Recording] = {}
        self._replayed: _Recording | None = None
        self._longest, self._expected = 0, 0.0
        self._tried: set[Hashable] = set()
        self._waits = self._is_full = self._has_said_too_many = False
        self._runs = 0

    def run(self, state: TrainingState, inputs: ViewInputs, run_pass: Pass) -> ViewMeasures:
        """Run the pass of a view, or replay it; what it returns is overwritten by the next call.
        The parameters of ``state`` get the gradients; they have none.

        Warns:
            MrgsWarning: the pass cannot be recorded. It runs as it is from now on; where memory did
                not suffice, until the parameters are others. Or views are of more than
                ``MOST_RECORDINGS`` kinds; the rest run unrecorded.
        """
        self._replayed = None
        self._runs += 1
        if self._waits or not all(term.replayable for term in inputs.terms):
            return run_pass(inputs)
        self._forget_if_others(state)
        if self._is_full:
            return run_pass(inputs)
        kind = _kind_of(state, inputs)
        recording = self._recordings.get(kind)
        if recording is None:
            return self._rehearse(kind, inputs, run_pass)
        recording.used = self._runs
        recording.take(inputs)
        if recording.graph is None:
            self._record(kind, recording, run_pass)
        if recording.graph is None:
            return run_pass(inputs)
        self._replayed = recording
        return recording.replay(self._parameters)

    def counted(self, finite: Bool[Tensor, ""]) -> Bool[Tensor, ""]:
        """Whether a step is finite, and the lists of its pass had room; on the device."""
        return finite if self._replayed is None else finite & self._replayed.suffices

    def had_room(self) -> bool:
        """Whether the lists of the last pass had room; the host waits for it. If not, the pass must
        be repeated: they have more from now on."""
        recording, self._replayed = self._replayed, None
        if recording is None or recording.graph is None:
            return True
        needed = recording.graph.number()
        self._longest = max(self._longest, needed)
        if needed <= recording.room:
            return True
        recording.clear()
        return False

    def forget(self) -> None:
        """Give the memory of all recordings back."""
        self._replayed = None
        self._recordings.clear()
        torch.cuda.empty_cache()

    def _forget_if_others(self, state: TrainingState) -> None:
        """Forget what was recorded of other parameters or other neighbours."""
        parameters, neighbours = state.parameters(), state.model.neighbours
        if neighbours is self._neighbours and [*map(id, parameters)] == [
            *map(id, self._parameters)
        ]:
            return
        if self._parameters:
            grown = len(parameters[0]) / max(len(self._parameters[0]), 1)
            self._expected, self._longest = grown * self._longest, 0
        self._parameters, self._neighbours = parameters, neighbours
        self._is_full = False
        self.forget()

    def _rehearse(self, kind: Hashable, inputs: ViewInputs, run_pass: Pass) -> ViewMeasures:
        """Run the pass with inputs that later views can take the place of."""
        if len(self._recordings) >= MOST_RECORDINGS:  # some may be of lower degrees, and be useless
            oldest, found = self._runs - STALE_AFTER, self._recordings.items()
            self._recordings = {other: each for other, each in found if each.used >= oldest}
        if len(self._recordings) >= MOST_RECORDINGS:
            if not self._has_said_too_many:
                self._has_said_too_many = True
                warn_user(
                    "views differ in size, intrinsics or modalities in too many ways: those beyond "
                    f"the first {MOST_RECORDINGS} kinds are trained without CUDA graphs, slower"
                )
            return run_pass(inputs)
        recording = self._recordings[kind] = _Recording(inputs, self._runs)
        room = ListRoom()
        with lists_have(room):
            measures = run_pass(recording.inputs)
        self._longest = max(self._longest, room.measured)
        return measures

    def _record(self, kind: Hashable, recording: _Recording, run_pass: Pass) -> None:
        """Record the pass of a kind of view, if that can be done."""

        def room() -> int:
            return int(SPARE * max(self._longest, self._expected)) + 1

        try:
            if kind not in self._tried:
                # A recording that a wait breaks off would leave torch's allocator (before 2.13) as
                # if it still recorded.
                with self._watched("error"):
                    recording.run(run_pass, self._parameters, room())
                self._tried.add(kind)
            work = partial(recording.run, run_pass, self._parameters, room())
            recording.graph = self._graph(work, self._device)
        except RuntimeError as error:
            self._is_full = lacks_memory(error)
            self._waits = not self._is_full
            problem = str(error).partition("\n")[0]
        else:
            return
        # Here the memory is free that the error's frames held.
        warn_user(f"steps cannot be recorded as a CUDA graph, and take longer: {problem}")
        for parameter in self._parameters:
            parameter.grad = None
        self.forget()


class _Recording:
    """A recorded pass, and the tensors that it reads and writes.

    Attributes:
        inputs: what the pass reads: copies of a view's, with stand-ins for the cameras.
        used: number of the run that last used it.
        graph: what can be replayed; None if it is not recorded yet.
        room: entries of the lists of the pass.
        suffices: whether the last replay needed no more, on the device.
    """

    def __init__(self, inputs: ViewInputs, used: int) -> None:
        self.used = used
        self._weights: dict[str, float | Tensor] = dict(inputs.weights)
        cameras, photos, device = inputs.cameras, inputs.photos, inputs.number.device
        self.inputs = inputs._replace(
            number=inputs.number.clone(),
            cameras={each: camera.recording_copy() for each, camera in cameras.items()},
            photos={each: change_each(pixels, Tensor.clone) for each, pixels in photos.items()},
            weights={
                name: torch.full((), float(weight), device=device)
                for name, weight in inputs.weights.items()
            },
        )
        self.clear()

    def clear(self) -> None:
        """Forget the recording."""
        self.graph: CudaGraph | None = None
        self._measures: ViewMeasures | None = None
        self._gradients: list[Tensor | None] = []

    def take(self, inputs: ViewInputs) -> None:
        """Have the pass read the inputs of another view of the same kind."""
        own = self.inputs
        own.number.copy_(inputs.number)
        for modality, camera in own.cameras.items():
            camera.copy_numbers_from(inputs.cameras[modality])
        for modality, pixels in own.photos.items():
            given = inputs.photos[modality]
            pixels.values.copy_(given.values)
            if pixels.valid is not None and given.valid is not None:
                pixels.valid.copy_(given.valid)
        for name, weight in inputs.weights.items():
            if weight != self._weights[name]:
                tensor = own.weights[name]
                assert isinstance(tensor, Tensor)
                tensor.fill_(weight)
        self._weights = dict(inputs.weights)

    def run(self, run_pass: Pass, parameters: Sequence[Tensor], room: int) -> Int64[Tensor, ""]:
        """The pass with lists of this room; the number of entries that the longest needs."""
        self._measures, self._gradients = None, []
        for parameter in parameters:
            parameter.grad = None
        self.room, lists = room, ListRoom(room)
        with lists_have(lists):
            self._measures = run_pass(self.inputs)
        self._gradients = [parameter.grad for parameter in parameters]
        needed = lists.needed()
        self.suffices = needed <= room
        return needed

    def replay(self, parameters: Sequence[Tensor]) -> ViewMeasures:
        """Run the recorded pass; its gradients are those of the parameters."""
        assert self.graph is not None
        self.graph.replay()
        for parameter, gradient in zip(parameters, self._gradients, strict=True):
            parameter.grad = gradient
        assert self._measures is not None
        return self._measures


def _kind_of(state: TrainingState, inputs: ViewInputs) -> Hashable:
    """Equal for views whose passes differ in the numbers of tensors alone."""
    cameras = inputs.cameras
    return (
        state.image_model.moves_poses,
        state.model.sh_degree,
        inputs.temperature_degree,
        tuple(term.name for term in inputs.terms),
        tuple(
            (modality, camera.width, camera.height, camera.K.numpy().tobytes())
            for modality, camera in cameras.items()
        ),
        tuple(a.coincides_with(b) for a, b in combinations(cameras.values(), 2)),
        tuple(
            (modality, tuple(pixels.values.shape), pixels.valid is None)
            for modality, pixels in inputs.photos.items()
        ),
        tuple(inputs.pixel_sizes.items()),
    )
