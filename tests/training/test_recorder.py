"""Passes that are replayed give what the passes themselves give.

Without a GPU, work that is "recorded" is kept and done again at each replay, by interpreted
kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mrgs import render as render_module
from mrgs.data import load_scene
from mrgs.errors import MrgsWarning
from mrgs.field import field as field_module
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.method.losses.terms import Photometric
from mrgs.scene import Pixels
from mrgs.training import recorder as module
from mrgs.training.recorder import Recorder
from mrgs.training.state import initial_state
from mrgs.training.step import training_step
from mrgs.training.view_pass import PhotographedView
from tests.helpers.training import short_config, tensors_of

VIEWS = (0, 1, 1, 0, 2, 1)


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
def kept(gpu_device, monkeypatch) -> type[KeptWork]:
    """What records, where there is no GPU; it counts the recordings."""
    if gpu_device != "cpu":
        pytest.skip("where there is a GPU, it records")

    class Kept(KeptWork):
        made = 0

    monkeypatch.setattr(module, "CudaGraph", Kept)
    for place, name in ((field_module, "_check_indices"), (render_module, "rows_in_view")):
        monkeypatch.setattr(place, name, lambda *_: None)
    return Kept


@pytest.fixture
def train(small_scene, gpu_device):
    """Takes steps on ``VIEWS``; returns losses and the state."""

    def taken(recorder: Recorder | None, method: str = "mrgs", masked: bool = False, **changes):
        device = torch.device(gpu_device)
        config = short_config(method, sh_every=1, **changes)
        config = replace(config, densification=replace(config.densification, max_gaussians=10))
        scene = load_scene(small_scene, resolution=8)
        state = initial_state(scene, config, device)
        scale, losses = SceneScale(scene.extent, scene.temperature), []
        for number in VIEWS:
            view = scene.train[number]
            photos = {
                modality: Pixels(
                    image.load().values.to(device),
                    image.load().values[..., 0].to(device) > 0.3 if masked else None,
                )
                for modality, image in view.images.items()
            }
            views = [PhotographedView(number, view, photos)]
            result = training_step(state, views, config, scale, recorder=recorder)
            losses.append(result.statistics.loss)
        return losses, state

    return taken


def assert_same(one, other) -> None:
    """Losses and states."""
    assert one[0] == other[0]
    expected = tensors_of(one[1])
    for name, tensor in tensors_of(other[1]).items():
        assert torch.equal(tensor, expected[name]), name


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("method", ["mrgs", "mrgs-plus", "3dgs-rgbt"])
def test_replayed_steps_are_those_that_are_not(train, kept, method, masked):
    expected = train(None, method, masked)
    assert_same(expected, train(Recorder(torch.device("cpu")), method, masked))
    assert kept.made > 0


def test_lists_without_room_are_repeated_with_more(train, kept, monkeypatch):
    expected = train(None)
    enough, sizes = Recorder._room, iter([1, 4])
    monkeypatch.setattr(Recorder, "_room", lambda self: next(sizes, None) or enough(self))
    assert_same(expected, train(Recorder(torch.device("cpu"))))
    assert next(sizes, None) is None


def test_other_neighbours_are_recorded_anew(train, kept):
    train(Recorder(torch.device("cpu")))
    assert kept.made > 0
    kept.made = 0
    train(Recorder(torch.device("cpu")), neighbours_every=1)
    assert kept.made == 0


def test_what_cannot_be_recorded_runs_as_it_is(train, kept, monkeypatch):
    expected = train(None)

    def fails(work: Callable[[], Tensor], device: torch.device) -> None:
        work()
        raise RuntimeError("operation not permitted when stream is capturing\nmore of it")

    monkeypatch.setattr(module, "CudaGraph", fails)
    with pytest.warns(MrgsWarning, match=r"take longer: .* capturing$") as caught:
        found = train(Recorder(torch.device("cpu")))
    assert_same(expected, found)
    assert len(caught) == 1


def test_terms_that_must_be_called_are_not_recorded(train, kept, monkeypatch):
    monkeypatch.setattr(Term, "replayable", False)
    train(Recorder(torch.device("cpu")))
    assert kept.made == 0


@pytest.mark.gpu
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("method", ["mrgs", "mrgs-plus", "3dgs-rgbt"])
def test_a_gpu_replays_what_it_recorded(train, method, masked):
    expected, _ = train(None, method, masked)
    recorder = Recorder(torch.device("cuda", 0))
    found, _ = train(recorder, method, masked)
    assert found == pytest.approx(expected, rel=1e-4)
    assert any(each.is_complete for each in recorder._recordings.values())
    assert not recorder._fails


@pytest.mark.gpu
def test_a_gpu_that_is_waited_for_runs_the_pass_as_it_is(train, monkeypatch):
    expected, _ = train(None)
    original = Photometric.value

    def waits(self: Photometric, context: LossContext) -> Tensor | None:
        torch.zeros(1, device="cuda").item()
        return original(self, context)

    monkeypatch.setattr(Photometric, "value", waits)
    with pytest.warns(MrgsWarning, match="cannot be recorded as a CUDA graph"):
        found, _ = train(Recorder(torch.device("cuda", 0)))
    assert found == pytest.approx(expected, rel=1e-4)
