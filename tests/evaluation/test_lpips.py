from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from mrgs import RGB, THERMAL, evaluate_run, load_run
from mrgs.errors import MrgsWarning, RunError
from mrgs.evaluation.lpips import KEPT_AS, Lpips, weight_shapes
from tests.helpers.runs import SMALL, trained_run


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    """Random weights, scaled so that the activations neither vanish nor explode; heads are
    positive, as LPIPS's are."""
    generator = torch.Generator().manual_seed(0)
    tensors = {}
    for name, shape in weight_shapes().items():
        values = torch.randn(shape, generator=generator)
        tensors[name] = values.abs() if name.startswith("lin") else values * 0.02
    return tensors


@pytest.fixture(scope="module")
def weights_file(weights: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "weights.safetensors"
    save_file({**weights, "classifier.0.bias": torch.zeros(3)}, path)
    return path


def random_image(seed: int, channels: int = 3) -> Tensor:
    return torch.rand(35, 48, channels, generator=torch.Generator().manual_seed(seed))


def test_layer_shapes(weights: dict[str, Tensor]) -> None:
    layers = Lpips(weights).features(random_image(0))
    expected = [(1, 64, 35, 48), (1, 128, 17, 24), (1, 256, 8, 12), (1, 512, 4, 6), (1, 512, 2, 3)]
    assert [tuple(layer.shape) for layer in layers] == expected


@pytest.mark.gpu
def test_the_network_runs_where_the_images_are(weights: dict[str, Tensor]) -> None:
    lpips, pair = Lpips(weights), (random_image(0), random_image(1))
    expected, found = lpips(*pair), lpips(*(image.cuda() for image in pair))
    assert found == pytest.approx(expected, rel=1e-4)
    assert lpips.features(pair[0].cuda())[0].is_cuda
    assert lpips(*pair) == expected


def test_distance_is_zero_for_identical_images_and_grows_with_noise(weights_file: Path) -> None:
    lpips = Lpips.from_file(weights_file)
    image = random_image(0)
    noise = random_image(1) - 0.5
    distances = [lpips(image + amount * noise, image) for amount in (0.0, 0.1, 0.5)]
    assert distances[0] == 0.0
    assert 0 < distances[1] < distances[2]


def test_distance_of_the_first_layer_by_hand(weights: dict[str, Tensor]) -> None:
    only_first = {
        name: torch.zeros_like(w) if name.startswith("lin") else w for name, w in weights.items()
    }
    only_first["lin0.model.1.weight"] = torch.ones(1, 64, 1, 1)
    lpips = Lpips(only_first)
    a, b = random_image(0), random_image(1)
    units = [
        layer / layer.norm(dim=1, keepdim=True)
        for layer in (lpips.features(a)[0], lpips.features(b)[0])
    ]
    cosine = (units[0] * units[1]).sum(dim=1).mean().item()
    assert lpips(a, b) == pytest.approx(2 - 2 * cosine, rel=1e-4)


def test_grey_is_shown_in_three_channels(weights: dict[str, Tensor]) -> None:
    lpips = Lpips(weights)
    a, b = random_image(0, 1), random_image(1, 1)
    assert lpips(a, b) == lpips(a.expand(-1, -1, 3), b.expand(-1, -1, 3))


def test_weights_that_the_page_converts_are_found_without_naming_them(
    weights: dict[str, Tensor],
    weights_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
    small_scene: Path,
) -> None:
    """With the names of the package lpips, which has each head twice."""
    slices = {0: 1, 5: 2, 10: 3, 17: 4, 24: 5}
    state = {}
    for name, tensor in weights.items():
        kind, number, rest = re.findall(r"([a-z]+)\.?(\d+)\.(.*)", name)[0]
        if kind == "lin":
            state |= {name: tensor, f"lins.{number}.{rest}": tensor}
        else:
            own = max(slices[first] for first in slices if first <= int(number))
            state[f"net.slice{own}.{number}.{rest}"] = tensor
    module = ModuleType("lpips")
    vars(module)["LPIPS"] = lambda net: SimpleNamespace(state_dict=lambda: state)
    monkeypatch.setitem(sys.modules, "lpips", module)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert Lpips.found(None) is None
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "convert.py").write_text(snippet)
    runpy.run_path(str(tmp_path / "convert.py"))
    found, given = Lpips.found(None), Lpips.found(weights_file)
    assert found is not None
    assert given is not None
    a, b = random_image(0), random_image(1)
    assert found(a, b) == given(a, b) == Lpips(weights)(a, b)

    run = load_run(trained_run(tmp_path_factory, small_scene, SMALL, tmp_path / "run"))
    means = evaluate_run(run).mean
    assert all(isinstance(means[modality]["lpips"], float) for modality in (RGB, THERMAL))


def test_damaged_weights_that_nobody_asked_for_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "hub" / "checkpoints" / KEPT_AS
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"half a download")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.warns(MrgsWarning, match=rf"LPIPS is left out: .*{KEPT_AS}.*delete"):
        assert Lpips.found(None) is None


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"vgg\.safetensors: no such"):
        Lpips.from_file(tmp_path / "vgg.safetensors")


def test_a_file_of_another_kind_is_named(tmp_path: Path) -> None:
    path = tmp_path / "vgg.pth"
    path.write_bytes(b"not safetensors at all")
    with pytest.raises(RunError, match=r"vgg\.pth: .*readable"):
        Lpips.from_file(path)


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({}, r"features\.0\.weight .*missing"),
        ({"features.0.weight": torch.zeros(2, 3)}, r"features\.0\.weight .*\[2, 3\]"),
    ],
)
def test_an_incompatible_file_says_which_tensor(
    tmp_path: Path, tensors: dict[str, Tensor], message: str
) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(1), **tensors}, path)
    with pytest.raises(RunError, match=message):
        Lpips.from_file(path)
