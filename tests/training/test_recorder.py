"""Passes that are replayed give what the passes themselves give.

Without a GPU, work that is "recorded" is kept and done again at each replay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from mrgs import render as render_module
from mrgs.data import load_scene
from mrgs.errors import MrgsWarning
from mrgs.method.config import make_config
from mrgs.method.losses.photometric import photometric_loss
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.method.losses.terms import Photometric
from mrgs.scene import RGB, THERMAL, Camera, Pixels
from mrgs.system.cuda_graph import room_of_list
from mrgs.training.recorder import MOST_RECORDINGS, STALE_AFTER, Recorder
from mrgs.training.state import initial_state
from mrgs.training.step import training_step
from mrgs.training.view_pass import PhotographedView, ViewInputs, ViewMeasures, view_inputs
from tests.helpers.training import short_config, tensors_of

CPU = torch.device("cpu")
FINITE = torch.tensor(True)


class KeptWork:
    """Stands in for ``CudaGraph``."""

    made: int

    def __init__(self, work: Callable[[], Tensor], device: torch.device) -> None:
        type(self).made += 1
        self._work = work

    def replay(self) -> None:
        self._number = self._work()

    def number(self) -> int:
        return int(self._number)


@pytest.fixture
def kept() -> type[KeptWork]:
    """What records; it counts the recordings."""

    class Kept(KeptWork):
        made = 0

    return Kept


def recorder_of(
    graph: Callable[..., Any],
    watched: Callable[..., AbstractContextManager[None]] = nullcontext,
) -> Recorder:
    """A recorder on the CPU, by something that stands in for ``CudaGraph``."""
    return Recorder(CPU, graph, watched)


class Numbers:
    """A state of one parameter, and a pass that returns all that it reads; its list has as many
    entries as the view's number says."""

    def __init__(self) -> None:
        self.model = SimpleNamespace(neighbours=None, sh_degree=0)
        self.image_model = SimpleNamespace(moves_poses=False)
        self.parameter = torch.zeros(2, requires_grad=True)
        self.passes = 0

    def parameters(self) -> list[Tensor]:
        return [self.parameter]

    def run_pass(self, inputs: ViewInputs) -> ViewMeasures:
        self.passes += 1
        camera = inputs.cameras[RGB]
        coarse = camera.resized(2, 2)
        room = room_of_list(inputs.number)
        read = {
            "number": inputs.number[0],
            "place": camera.tensors(CPU).position[0],
            "same place": coarse.tensors(CPU, torch.float32).position[0],
            "photo": inputs.photos[RGB].values.sum(),
            "valid": inputs.photos[RGB].valid.sum(),
            "weight": torch.as_tensor(inputs.weights["rgb"]),
            "entries": inputs.number[0].clamp_max(room),
        }
        self.parameter.grad = torch.full((2,), float(read["entries"]))
        return ViewMeasures(torch.zeros(()), read, None, None, [])


def inputs_of(number: int, size: int = 4, replayable: bool = True) -> ViewInputs:
    """Of a view whose numbers all follow from its own."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -number
    camera = Camera(torch.eye(3, dtype=torch.float64), viewmat, size, size)
    photo = Pixels(torch.full((size, size, 3), float(number)), torch.arange(16).view(4, 4) < number)
    term: Any = SimpleNamespace(name="rgb", replayable=replayable)
    weights = {"rgb": 0.5 * number}
    return ViewInputs(torch.tensor([number]), {RGB: camera}, {RGB: photo}, {}, [term], weights, 0)


def step(recorder: Recorder, state: Any, inputs: ViewInputs) -> dict[str, float]:
    """Steps on a view until its lists have room; what the pass read."""
    while True:
        state.parameter.grad = None
        measures = recorder.run(state, inputs, state.run_pass)
        counts = bool(recorder.counted(FINITE))
        assert bool(counts) == (measures.terms["entries"] == measures.terms["number"])
        if recorder.had_room():
            assert counts
            assert state.parameter.grad.tolist() == [float(measures.terms["number"])] * 2
            return {name: float(value) for name, value in measures.terms.items()}


def expected(number: int) -> dict[str, float]:
    return {
        "number": number,
        "place": number,
        "same place": number,
        "photo": 48 * number,
        "valid": number,
        "weight": 0.5 * number,
        "entries": number,
    }


def test_a_replay_reads_the_numbers_of_its_view(kept):
    recorder, state = recorder_of(kept), Numbers()
    for number in (5, 6, 3, 6):
        assert step(recorder, state, inputs_of(number)) == expected(number)
    assert kept.made == 1


def test_lists_without_room_are_repeated_with_more(kept):
    recorder, state = recorder_of(kept), Numbers()
    for number in (5, 6, 14, 13):
        assert step(recorder, state, inputs_of(number)) == expected(number)
    assert kept.made == 2
    assert state.passes == 1 + 1 + 1 + 2 + 1  # the second view's is tried before it is recorded


def of_focal(focal_px: float) -> ViewInputs:
    """Of a camera with a focal length of its own."""
    inputs = inputs_of(3)
    (camera,) = inputs.cameras.values()
    K = torch.diag(torch.tensor([focal_px, focal_px, 1.0], dtype=torch.float64))
    return inputs._replace(cameras={RGB: Camera(K, camera.viewmat, camera.width, camera.height)})


def test_each_kind_of_view_has_a_recording_and_there_are_not_many(kept):
    recorder, state = recorder_of(kept), Numbers()
    kinds = range(1, MOST_RECORDINGS + 1)
    for focal_px in kinds:
        step(recorder, state, of_focal(focal_px))
    with pytest.warns(MrgsWarning, match=f"first {MOST_RECORDINGS} kinds"):
        step(recorder, state, of_focal(99))
    for focal_px in (*kinds, 99, 99):  # and no more warnings
        step(recorder, state, of_focal(focal_px))
    assert kept.made == MOST_RECORDINGS


def test_what_no_view_is_of_any_more_makes_room(kept):
    recorder, state = recorder_of(kept), Numbers()
    for focal_px in range(1, MOST_RECORDINGS + 1):
        for _ in range(2):
            step(recorder, state, of_focal(focal_px))
    for _ in range(STALE_AFTER):
        step(recorder, state, of_focal(1))
    for _ in range(2):
        step(recorder, state, of_focal(99))
    assert kept.made == MOST_RECORDINGS + 1


def test_a_pass_that_moves_poses_is_another_one(kept):
    recorder, state = recorder_of(kept), Numbers()
    for state.image_model.moves_poses in (False, False, True, True):
        assert step(recorder, state, inputs_of(4)) == expected(4)
    assert kept.made == 2


@pytest.mark.parametrize("what", ["parameter", "neighbours"])
def test_other_parameters_and_other_neighbours_are_recorded_anew(kept, what):
    recorder, state = recorder_of(kept), Numbers()
    for _ in range(3):
        step(recorder, state, inputs_of(4))
    assert kept.made == 1
    if what == "parameter":
        state.parameter = torch.zeros(2, requires_grad=True)
    else:
        state.model.neighbours = torch.zeros(2, 1, dtype=torch.int64)
    for _ in range(3):
        assert step(recorder, state, inputs_of(4)) == expected(4)
    assert kept.made == 2


def test_what_cannot_be_recorded_runs_as_it_is():
    def fails(work: Callable[[], Tensor], device: torch.device) -> None:
        work()
        raise RuntimeError("operation not permitted when stream is capturing\nmore of it")

    recorder, state = recorder_of(fails), Numbers()
    step(recorder, state, inputs_of(4))
    with pytest.warns(MrgsWarning, match="capturing$"):
        assert step(recorder, state, inputs_of(2)) == expected(2)
    state.parameter = torch.zeros(2, requires_grad=True)
    for number in (3, 2, 4):
        assert step(recorder, state, inputs_of(number)) == expected(number)


def test_what_waits_is_not_recorded_at_all(kept):
    @contextmanager
    def fails_after(mode):
        assert mode == "error"
        yield
        raise RuntimeError("called a synchronizing CUDA operation")

    recorder, state = recorder_of(kept, fails_after), Numbers()
    step(recorder, state, inputs_of(4))
    with pytest.warns(MrgsWarning, match="synchronizing"):
        assert step(recorder, state, inputs_of(2)) == expected(2)
    assert step(recorder, state, inputs_of(3)) == expected(3)
    assert kept.made == 0


def test_each_kind_is_tried_once_with_waits_as_errors(kept):
    tried = []

    @contextmanager
    def counted(mode):
        tried.append(mode)
        yield

    recorder, state = recorder_of(kept, counted), Numbers()
    for degree in (0, 0, 1, 1, 1):
        state.model.sh_degree = degree
        step(recorder, state, inputs_of(3))
    assert tried == ["error"] * 2
    state.parameter = torch.zeros(2, requires_grad=True)
    for _ in range(3):
        step(recorder, state, inputs_of(3))
    assert (len(tried), kept.made) == (2, 3)


def test_where_memory_does_not_suffice_for_a_recording_other_parameters_are_recorded(kept):
    is_full = iter([True])

    def graph(work: Callable[[], Tensor], device: torch.device) -> KeptWork:
        if next(is_full, False):
            work()
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return kept(work, device)

    recorder, state = recorder_of(graph), Numbers()
    step(recorder, state, inputs_of(4))
    with pytest.warns(MrgsWarning, match="out of memory"):
        assert step(recorder, state, inputs_of(2)) == expected(2)
    for number in (3, 2):
        assert step(recorder, state, inputs_of(number)) == expected(number)
    assert kept.made == 0
    state.parameter = torch.zeros(2, requires_grad=True)
    for number in (3, 2, 4):
        assert step(recorder, state, inputs_of(number)) == expected(number)
    assert kept.made == 1


def test_gradients_from_before_are_not_recorded(kept):
    recorder, state = recorder_of(kept), Numbers()
    step(recorder, state, inputs_of(4))
    state.parameter.grad = torch.full((2,), 100.0)

    def adds(inputs: ViewInputs) -> ViewMeasures:
        before = state.parameter.grad
        measures = state.run_pass(inputs)
        if before is not None:
            state.parameter.grad += before
        return measures

    for _ in range(2):
        recorder.run(state, inputs_of(4), adds)
        assert state.parameter.grad.tolist() == [4.0, 4.0]


def test_terms_that_must_be_called_are_not_recorded(kept):
    recorder, state = recorder_of(kept), Numbers()
    for number in (1, 2, 3):
        inputs = inputs_of(number, replayable=False)
        assert step(recorder, state, inputs) == expected(number)
    assert kept.made == 0


class PlainlyPhotometric(Photometric):
    """Without its kernel, which would take most of a step where it is interpreted."""

    def value(self, context: LossContext) -> Tensor | None:
        photo, image = context.photos[self._modality], context.observed[self._modality].image
        return photometric_loss.plain(image, photo.values, photo.valid, 0.2, 0.0)


@pytest.fixture
def train(small_scene, gpu_device, monkeypatch):
    """Takes steps on three views; returns losses and the state."""
    if gpu_device == "cpu":  # where tensors stand for a GPU's
        monkeypatch.setattr(render_module, "rows_in_view", lambda *_: None)

    def taken(
        recorder: Recorder | None,
        method: str = "3dgs-rgbt",
        masked: bool = False,
        poses: bool = False,
        terms: Sequence[Term] = (),
    ):
        device = torch.device(gpu_device)
        config = short_config(method)
        config = replace(config, image_model=replace(config.image_model, poses=poses))
        config = replace(config, densification=replace(config.densification, max_gaussians=10))
        if gpu_device == "cpu":
            plain = (PlainlyPhotometric(each, config.loss) for each in (RGB, THERMAL))
            terms = [*plain, *terms]
        scene = load_scene(small_scene, resolution=8)
        state = initial_state(scene, config, device, terms=terms)
        scale, losses = SceneScale(scene.extent, scene.temperature), []
        for number in range(3):
            view = scene.train[number]
            photos = {}
            for modality in (RGB, THERMAL):
                values = view.images[modality].load().values.to(device)
                photos[modality] = Pixels(values, values[..., 0] > 0.3 if masked else None)
            views = [PhotographedView(number, view, photos)]
            result = training_step(state, views, config, scale, recorder=recorder)
            losses.append(result.statistics.loss)
        return losses, state

    return taken


@pytest.mark.slow
@pytest.mark.parametrize("poses", [False, True])
def test_replayed_steps_are_those_that_are_not(poses, train, kept, gpu_device):
    if gpu_device != "cpu":
        pytest.skip("where there is a GPU, it records")
    losses, state = train(None, poses=poses)
    replayed_losses, replayed = train(recorder_of(kept), poses=poses)
    assert kept.made == 1
    assert replayed_losses == losses
    tensors = tensors_of(state)
    for name, tensor in tensors_of(replayed).items():
        assert torch.equal(tensor, tensors[name]), name


def test_steps_are_of_one_kind_where_the_temperature_has_no_harmonics(small_scene):
    config, scene = make_config("mrgs-plus"), load_scene(small_scene)
    state, view = initial_state(scene, config), scene.train[0]
    assert not state.model.gaussians.depends_on_view(THERMAL)
    photos = {modality: image.load() for modality, image in view.images.items()}
    for state.step in (3_000, 3_001):
        inputs = view_inputs(state, PhotographedView(0, view, photos), config)
        assert inputs.temperature_degree == 0
    assert {config.temperature_sh_degree_at(step) for step in (3_000, 3_001)} == {0, 3}


@pytest.mark.gpu
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("method", ["mrgs", "mrgs-plus", "3dgs-rgbt"])
def test_a_gpu_replays_what_it_recorded(train, method, masked):
    losses, _ = train(None, method, masked)
    recorder = Recorder(torch.device("cuda", 0))
    replayed, _ = train(recorder, method, masked)
    assert replayed == pytest.approx(losses, rel=1e-4)
    assert any(each.graph is not None for each in recorder._recordings.values())


class Waits(Term):
    """Has nothing to say, and asks the GPU for a number."""

    name = "waits"

    def value(self, context: LossContext) -> Tensor | None:
        torch.zeros(1, device="cuda").item()
        return None


@pytest.mark.gpu
def test_a_gpu_that_is_waited_for_runs_the_pass_as_it_is(train):
    losses, _ = train(None)
    with pytest.warns(MrgsWarning, match="cannot be recorded"):
        found, _ = train(Recorder(torch.device("cuda", 0)), terms=[Waits()])
    assert found == pytest.approx(losses, rel=1e-4)
