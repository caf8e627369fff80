"""What reads is what runs: an equation that is edited in a copy of the package takes effect."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from tests.helpers.runs import made_once

SOURCE = Path(__file__).parents[2] / "src"

TRAIN = """
import sys, warnings
from dataclasses import replace
from mrgs.errors import MrgsWarning
from mrgs.training import make_config, train
from mrgs.training.start import TrainOptions

scene, output, mode, *opened = sys.argv[1:]
config = make_config("mrgs", "fast", max_steps=20, resolution=24)
config = replace(config, fitted_residuals=20)  # steps on the same points multiply rounding
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", MrgsWarning)
    for path in opened:
        from mrgs.runs.open import load_run
        run = load_run(path, device="cpu")
        run.render_view(run.load_scene().eval[0])
        for warning in caught:
            print("opened:", warning.message)
        caught.clear()
    train(scene, output, config, TrainOptions(device="cpu", plain=mode == "plain"))
for warning in caught:
    if issubclass(warning.category, MrgsWarning):
        print(warning.message)
print("numba:", "numba" in sys.modules, "torch._dynamo:", "torch._dynamo" in sys.modules)
"""

EDITS = {
    "temperature_residuals": (
        "field/heat.py",
        "mean = surroundings.mean(",
        "mean = surroundings.amax(",
    ),
    "photometric_loss": (
        "method/losses/photometric.py",
        "(1 - dssim) * _huber(x - y, huber_width)",
        "(1 - dssim) * (x - y).square()",
    ),
    "color_residuals": (
        "field/appearance.py",
        "self.scale * self.mlp(inputs)",
        "self.scale * self.mlp(inputs).sin()",
    ),
}
"""An equation of each operation, as it reads and as it is edited."""

RENDERING = ("temperature_residuals", "color_residuals")
"""Those that a run that is opened uses as well."""


def copied_package(folder: Path) -> Path:
    """A copy with its compiled kernels."""
    shutil.copytree(SOURCE / "mrgs", folder / "mrgs")
    return folder


def trained(
    package: Path, scene: Path, output: Path, *opened: Path, mode: str = "kernels"
) -> tuple[dict[str, torch.Tensor], list[str]]:
    """The parameters after a training by a copy of the package, which opened some runs before, and
    what it printed."""
    path = [str(package), *filter(None, sys.path)]
    run = subprocess.run(
        [
            *(sys.executable, "-c", f"import sys; sys.path[:0] = {path!r}\n{TRAIN}"),
            *map(str, (scene, output, mode, *opened)),
        ],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return parameters(output), run.stdout.splitlines()


def parameters(run: Path) -> dict[str, torch.Tensor]:
    (checkpoint,) = (run / "checkpoints").glob("*.safetensors")
    return load_file(checkpoint)


def logged(run: Path) -> list[dict[str, float]]:
    """What the log says of losses and of the parts of the model."""
    entries = map(json.loads, (run / "log.jsonl").read_text(encoding="utf-8").splitlines())
    return [{name: each for name, each in e.items() if name != "seconds"} for e in entries]


@pytest.fixture
def unedited(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run by the package as it is, without a warning."""

    def make(folder: Path) -> None:
        _, printed = trained(SOURCE, small_scene, folder)
        assert printed == ["numba: True torch._dynamo: False"]

    return made_once(tmp_path_factory, "unedited", make)


@pytest.mark.slow
def test_edited_equations_run_in_training_and_in_opened_runs_and_one_line_names_each(
    small_scene, unedited, tmp_path
):
    package = copied_package(tmp_path / "source")
    for file, before, after in EDITS.values():
        path = package / "mrgs" / file
        text = path.read_text(encoding="utf-8")
        assert text.count(before) == 1
        path.write_text(text.replace(before, after), encoding="utf-8")

    model, printed = trained(package, small_scene, tmp_path / "edited", unedited)

    def named(lines: list[str]) -> set[str]:
        differs = ": the kernel differs from the plain definition"
        return {line.partition(differs)[0] for line in lines}

    opened = [line.removeprefix("opened: ") for line in printed if line.startswith("opened: ")]
    assert named(opened) == set(RENDERING)
    assert len(opened) == len(RENDERING)
    trained_with = printed[len(opened) : -1]
    assert named(trained_with) == set(EDITS)
    assert len(trained_with) == len(EDITS)
    expected = parameters(unedited)
    for name in ("gaussians.means", "gaussians.embedding"):
        assert not torch.equal(model[name], expected[name])


@pytest.mark.slow
def test_a_plain_training_needs_no_numba_and_learns_the_same(small_scene, unedited, tmp_path):
    _, printed = trained(SOURCE, small_scene, tmp_path / "plain", mode="plain")
    assert printed == ["numba: False torch._dynamo: False"]
    # Rounding differs, and each step multiplies that in single parameters, but not in these.
    for found, expected in zip(logged(tmp_path / "plain"), logged(unedited), strict=True):
        assert found == pytest.approx(expected, rel=0.01)
