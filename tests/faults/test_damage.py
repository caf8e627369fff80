"""Damaged and crafted checkpoints: each is refused, or gives way to the one before it."""

from __future__ import annotations

import os
import random
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, load_file
from torch import Tensor

from mrgs.errors import DamagedCheckpointError, MrgsError, MrgsWarning, RunError
from mrgs.runs.open import load_run
from mrgs.training import train
from mrgs.training.start import TrainOptions
from mrgs_thermonerf import open_thermonerf, train_thermonerf
from tests.faults.runs import GAUSSIANS, NERF, load_gaussians, load_nerf
from tests.helpers.checkpoints import rewrite, rewrite_unchecked

KINDS = ("gaussians", pytest.param("nerf", marks=pytest.mark.slow))
LOAD = {"gaussians": load_gaussians, "nerf": load_nerf}
TRAIN = {"gaussians": (train, GAUSSIANS), "nerf": (train_thermonerf, NERF)}
OPEN = {"gaussians": load_run, "nerf": open_thermonerf}


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def folder(kind, request):
    return request.getfixturevalue(f"{kind}_run")


def damaged_copies(good: bytes) -> Iterator[bytes]:
    """A file with one bit changed, in the header and anywhere, and cut at several places."""
    rng = random.Random(1)
    header = 8 + int.from_bytes(good[:8], "little")
    ends = [8, header, header, *[len(good)] * 6]
    for end in ends:
        data = bytearray(good)
        data[rng.randrange(end)] ^= 1 << rng.randrange(8)
        yield bytes(data)
    for end in (0, 7, 8, header - 1, header, header + 1, len(good) - 1, rng.randrange(len(good))):
        yield good[:end]
    yield good + b"\0"
    yield good[:8] + good[header:]


def test_one_bit_or_one_byte_is_enough(kind, folder):
    newest = folder.newest_checkpoint()
    good = newest.read_bytes()
    for data in damaged_copies(good):
        newest.write_bytes(data)
        with pytest.warns(MrgsWarning, match=r"step_000010\.safetensors.*whole") as caught:
            state = folder.load_newest(LOAD[kind])
        assert state.step == 5
        assert str(caught[0].message).count("step_000005.safetensors") == 1
    newest.write_bytes(good)
    assert folder.load_newest(LOAD[kind]).step == 10


def test_a_damaged_run_still_renders(kind, folder):
    newest = folder.newest_checkpoint()
    newest.write_bytes(newest.read_bytes()[:-1])
    with pytest.warns(MrgsWarning, match="not a whole"):
        assert OPEN[kind](folder.path).facts.step == 5


def test_training_goes_on_from_the_checkpoint_before_exactly(kind, folder, small_scene):
    newest = folder.newest_checkpoint()
    data = newest.read_bytes()[:-100]
    expected = load(newest.read_bytes())
    newest.write_bytes(data)
    do_train, config = TRAIN[kind]
    with pytest.warns(MrgsWarning, match=r"step_000010\.safetensors\.damaged"):
        do_train(small_scene, folder.path, config, TrainOptions(resume=True))
    found = load_file(folder.newest_checkpoint())
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    assert newest.with_name("step_000010.safetensors.damaged").read_bytes() == data


def test_without_a_whole_checkpoint_nothing_is_thrown_away(kind, folder, small_scene):
    for path in folder.checkpoints():
        path.write_bytes(path.read_bytes()[:300])
    do_train, config = TRAIN[kind]
    for use in (
        lambda: OPEN[kind](folder.path),
        lambda: do_train(small_scene, folder.path, config, TrainOptions(resume=True)),
    ):
        with pytest.raises(RunError, match=r"whole .*restore") as caught:
            use()
        assert str(caught.value).startswith(str(folder.path))
    assert len(folder.checkpoints()) == 2


def test_what_cannot_be_read_is_not_called_damaged(kind, folder, monkeypatch):
    newest = folder.newest_checkpoint()
    original = Path.open

    def refuse(path, *args, **options):
        if path == newest:
            raise PermissionError(13, "Permission denied")
        return original(path, *args, **options)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(RunError) as caught:
        folder.load_newest(LOAD[kind])
    assert not isinstance(caught.value, DamagedCheckpointError)
    message = str(caught.value)
    assert message.startswith(str(newest))
    assert "(Permission denied)" in message


def test_what_is_no_file_is_not_waited_for(kind, folder):
    newest = folder.newest_checkpoint()
    newest.unlink()
    newest.mkdir()
    with pytest.raises(RunError, match="not a file"):
        folder.load_newest(LOAD[kind])


def other_forms(tensor: Tensor) -> Iterator[Tensor]:
    """Tensors that are no tensor of this type and shape."""
    other = torch.float64 if tensor.dtype == torch.float32 else torch.float32
    yield tensor.to(other)
    yield tensor[None]
    if tensor.dim() == 0:
        return
    yield torch.cat([tensor, tensor], dim=-1)
    yield tensor[:0]
    if len(tensor) > 1:
        yield tensor[:1]
        yield tensor[..., :-1] if tensor.shape[-1] > 0 else tensor[:-1]


def same_form(one: Tensor, other: Tensor) -> bool:
    return one.dtype == other.dtype and one.shape == other.shape


EVERY_FORM = (
    "gaussians.means",
    "gaussians.embedding",
    "gaussians.adam.quats.exp_avg",
    "layer_optimizer.5.exp_avg_sq",
    "neighbours",
    "strategy.views",
    "model.field.grid.table",
    "adam.field.grid.table.step",
    "frame.sizes",
)


@pytest.mark.slow
def test_a_tensor_of_another_form_is_refused_although_the_digests_are_right(kind, folder):
    path = folder.newest_checkpoint()
    good = load_file(path)
    loose = {name: good.pop(name) for name in ("generator", "sampler.waiting") if name in good}
    for place, name in enumerate([*EVERY_FORM, *list(good)[::2]]):
        if name not in good:
            continue
        tensor = good[name]
        forms = [form for form in other_forms(tensor) if not same_form(form, tensor)]
        for form in forms if place < len(EVERY_FORM) else [forms[place % len(forms)]]:
            rewrite(path, {**good, **loose, name: form.contiguous()})
            with pytest.raises(RunError, match="does not fit") as caught:
                LOAD[kind](path)
            assert "\n" not in str(caught.value)


def test_missing_and_unknown_tensors_are_refused(kind, folder):
    path = folder.newest_checkpoint()
    good = load_file(path)
    for name in list(good)[::6]:
        if name != "neighbours":  # right after a densification there are none
            rewrite(path, {key: tensor for key, tensor in good.items() if key != name})
            with pytest.raises(RunError, match="does not fit"):
                LOAD[kind](path)
    for name in ("more", "gaussians.more", "adam.more.step", "neighbors"):
        rewrite(path, {**good, name: torch.zeros(3)})
        with pytest.raises(RunError, match="does not fit"):
            LOAD[kind](path)


def test_values_that_no_optimizer_has_are_refused(kind, folder):
    path = folder.newest_checkpoint()
    good = load_file(path)
    for ending in (".step", ".exp_avg_sq"):
        name = next(name for name in good if name.endswith(ending))
        rewrite(path, {**good, name: good[name] - 100})
        with pytest.raises(RunError, match="are negative"):
            LOAD[kind](path)


def test_neighbours_and_views_that_do_not_exist_are_refused(gaussians_run):
    path = gaussians_run.newest_checkpoint()
    good = load_file(path)
    neighbours = good["neighbours"]
    for wrong in (neighbours + len(neighbours), neighbours - len(neighbours)):
        rewrite(path, {**good, "neighbours": wrong})
        for use in (load_gaussians, lambda file: load_run(file.parents[1])):
            with pytest.raises(RunError, match="do not exist"):
                use(path)
    for waiting in ([6], [-1], [0, 0]):
        rewrite(path, {**good, "sampler.waiting": torch.tensor(waiting)})
        with pytest.raises(RunError, match="the round"):
            load_gaussians(path)


@pytest.mark.slow
def test_a_generator_of_any_bits_is_refused_or_draws(gaussians_run):
    path = gaussians_run.newest_checkpoint()
    good = load_file(path)
    rng = random.Random(3)
    for _ in range(30):
        state = good["generator"].clone()
        for _ in range(rng.choice([1, 4])):
            state[rng.randrange(len(state))] = rng.randrange(256)
        rewrite(path, {**good, "generator": state})
        with suppress(MrgsError):
            generator = load_gaussians(path).generator
            assert 0 <= torch.randint(5, (1_000,), generator=generator).min() < 5


@pytest.mark.parametrize(
    "value", [float("nan"), pytest.param(float("inf"), marks=pytest.mark.slow)]
)
def test_values_that_are_not_finite_count_as_damage(value, kind, folder):
    path = folder.newest_checkpoint()
    good = load_file(path)
    names = [name for name, each in good.items() if each.is_floating_point() and each.numel()]
    for name in names[::10]:
        wrong = good[name].clone()
        wrong.view(-1)[-1] = value
        rewrite_unchecked(path, {**good, name: wrong})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert folder.load_newest(LOAD[kind]).step == 5
        message = str(caught[0].message)
        assert name in message
        assert "not finite" in message


def test_a_checkpoint_under_the_name_of_another_step_hides_nothing(kind, folder):
    path = folder.newest_checkpoint()
    path.with_name("step_999999.safetensors").write_bytes(path.read_bytes())
    with pytest.warns(MrgsWarning, match=r"step_999999.*step 10\)"):
        assert folder.load_newest(LOAD[kind]).step == 10


def test_a_configuration_that_was_cut_off_is_said(kind, folder):
    lines = folder.config_file.read_text().splitlines(keepends=True)
    folder.config_file.write_text("".join(lines[:-1]))
    with pytest.warns(MrgsWarning, match=r"config\.yaml lacks"):
        OPEN[kind](folder.path)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_log_that_is_no_file_is_named(make, kind, folder, small_scene):
    folder.log_file.unlink(missing_ok=True)
    make(folder.log_file)
    do_train, config = TRAIN[kind]
    with pytest.raises(RunError, match=r"log\.jsonl"):
        do_train(small_scene, folder.path, config, TrainOptions(resume=True))
