"""Every recipe of docs/extending.md does what it says, as it stands there."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mrgs import evaluate_run, load_run, load_scene, make_config, train
from mrgs.data.radiometric import read, read_thermal_photo
from mrgs.errors import MrgsWarning
from mrgs.export import FORMATS
from mrgs.field import RadianceField
from mrgs.field.heat import FourierHeatTransformation
from mrgs.prepare.pairs.inventory import inspect
from mrgs.prepare.pairs.photo import Photo
from mrgs.runs import registry
from mrgs.scene import RGB, THERMAL, Modality
from mrgs.system import operation
from tests.helpers.runs import trained_run

pytestmark = pytest.mark.compares_kernels

PAGE = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
RECIPES = {
    title: dict(re.findall(r"```(\w+)\n(.*?)```", body, re.DOTALL))
    for title, body in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
}
CONFIG = make_config("mrgs", "fast", max_steps=4, max_gaussians=60)


class Kitchen:
    """Runs a recipe in a folder of its own, with a small scene and few steps.

    Attributes:
        scene: of the recipe.
        run: trained on it.
    """

    def __init__(self, folder: Path, scene: Path, run: Path) -> None:
        self._folder = folder
        self.scene = scene
        self.run = run

    def cook(self, title: str) -> dict[str, Any]:
        """The names that a recipe defines."""
        script = self._folder / "recipe.py"
        script.write_text(RECIPES[title]["python"], encoding="utf-8")
        names = {"SCENE": str(self.scene), "RUN": str(self.run), "CONFIG": CONFIG}
        return runpy.run_path(str(script), names)


@pytest.fixture
def kitchen(
    small_scene: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Kitchen]:
    """What recipes register is forgotten afterwards."""
    run = trained_run(tmp_path_factory, small_scene, CONFIG, tmp_path / "trained")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_METHODS", registry._METHODS.copy())
    monkeypatch.setattr(operation, "_registered", operation._registered.copy())
    readers, formats = read.READERS.copy(), FORMATS.copy()
    monkeypatch.setattr(FourierHeatTransformation, "forward", FourierHeatTransformation.forward)
    monkeypatch.setattr(RadianceField.temperature_residuals, "rejected", set())
    yield Kitchen(tmp_path, small_scene, run)
    read.READERS[:] = readers
    FORMATS.clear()
    FORMATS.update(formats)


def logged(run: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (Path(run) / "log.jsonl").read_text().splitlines()]


def test_every_recipe_is_tested() -> None:
    tests = Path(__file__).read_text(encoding="utf-8")
    assert len(RECIPES) == 9
    assert [title for title in RECIPES if f'cook("{title}"' not in tests] == []


def test_the_names_that_recipes_use_are_explained() -> None:
    first = PAGE[: PAGE.index("\n## ")]
    assert all(
        re.search(rf"^{name} = ", first, re.MULTILINE) for name in ("SCENE", "RUN", "CONFIG")
    )


def test_another_densification(kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch) -> None:
    text = RECIPES["Another densification"]["python"].replace("every=50", "every=2")
    monkeypatch.setitem(RECIPES["Another densification"], "python", text)
    kitchen.cook("Another densification")
    assert [line["step"] for line in logged("runs/prune-only") if "pruned" in line] == [2, 4]
    (strategy,) = load_run("runs/prune-only").folder.custom_parts
    assert strategy.startswith("strategy: <run_path>.PruneOnly(")
    assert "every=2" in strategy


def test_a_modality(kitchen: Kitchen) -> None:
    kitchen.scene = shutil.copytree(kitchen.scene, Path("scene"))
    shutil.copytree(kitchen.scene / "thermal", kitchen.scene / "nir")
    file = kitchen.scene / "transforms.json"
    listed = json.loads(RECIPES["A modality"]["json"])
    file.write_text(json.dumps(json.loads(file.read_text()) | listed))
    names = kitchen.cook("A modality")
    assert load_scene(kitchen.scene).modalities == (RGB, THERMAL, Modality("nir", 1))
    assert names["blend"].image.shape == (30, 40, 1)
    assert any("loss_nir" in line for line in logged("runs/nir"))


def test_another_heat_equation(kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch) -> None:
    own = FourierHeatTransformation.forward
    with pytest.warns(MrgsWarning, match="the kernel differs"):
        kitchen.cook("Another heat equation")
    assert RadianceField.temperature_residuals.rejected
    run = load_run("runs/diffusion")
    assert run.facts.step == CONFIG.max_steps
    name = "mrgs.field.heat.FourierHeatTransformation.forward"
    equation, kernel = sorted(run.folder.custom_parts)
    assert equation == f"equation: {name}: <run_path>.diffusion"
    assert kernel.startswith("kernel: mrgs.field.field.RadianceField.temperature_residuals")
    evaluate_run(run)
    scores = Path("runs/diffusion/eval/metrics.md").read_text()
    assert re.search(r"^- custom equation: .*FourierHeatTransformation.*diffusion", scores, re.M)
    monkeypatch.setattr(FourierHeatTransformation, "forward", own)
    with pytest.warns(MrgsWarning, match=r"FourierHeatTransformation\.forward"):
        load_run("runs/diffusion")
    with pytest.warns(MrgsWarning, match=r"FourierHeatTransformation\.forward"):
        train(kitchen.scene, "runs/diffusion", resume=True)


def test_a_loss(kitchen: Kitchen) -> None:
    kitchen.cook("A loss")
    assert load_run("runs/sparse").folder.custom_parts == ["term: sparsity: <run_path>.Sparsity"]
    assert any(0 < line.get("loss_sparsity", 0) < 1 for line in logged("runs/sparse"))


def test_a_prior_between_neighbours(kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch) -> None:
    text = RECIPES["A prior between neighbours"]["python"].replace("step % 16 == 0", "True")
    monkeypatch.setitem(RECIPES["A prior between neighbours"], "python", text)
    names = kitchen.cook("A prior between neighbours")
    assert all(line["loss_conduction"] >= 0 for line in logged("runs/conduction"))
    gaussians = load_run("runs/conduction").model.gaussians
    near = torch.arange(len(gaussians)).roll(1)[:, None]
    weights = names["likeness"](gaussians, near)
    assert 0 <= weights.min() <= weights.max() <= 1
    gaussians.sh_dc[RGB] = gaussians.sh_dc[RGB] * 0  # of one colour
    assert (names["likeness"](gaussians, near) >= weights - 1e-6).all()


def test_a_kernel(kitchen: Kitchen) -> None:
    names = kitchen.cook("A kernel")
    spread = names["spread"]
    assert spread.kernel([torch.rand(3)]) is names["fast_spread"]
    assert not spread.rejected
    assert names["compiled_spread"].signatures
    assert any(0 < line.get("loss_decided", 0) < 0.25 for line in logged("runs/decided"))


def test_a_method(kitchen: Kitchen) -> None:
    kitchen.cook("A method")
    run = load_run("runs/far")
    assert (run.config.method, run.config.field.neighbours_k) == ("mrgs-far", 24)


def test_a_camera_maker(kitchen: Kitchen, tmp_path: Path) -> None:
    celsius = np.linspace(10, 30, 12, dtype="<f4").reshape(3, 4)
    file = tmp_path / "photo.acme"
    file.write_bytes(b"ACME" + np.array([4, 3], "<u2").tobytes() + celsius.tobytes())
    relative = file.relative_to(tmp_path)
    assert inspect(file, relative) == "is not a photo"
    kitchen.cook("A camera maker")
    np.testing.assert_array_equal(read_thermal_photo(file).temperature_c, celsius)
    found = inspect(file, relative)
    assert isinstance(found, Photo)
    assert found.is_thermal


def test_an_export(kitchen: Kitchen) -> None:
    names = kitchen.cook("An export")
    written = np.array(json.loads(Path("exports/centres.json").read_text()))
    assert written.shape == (names["run"].gaussian_count, 3)
