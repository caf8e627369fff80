"""What reads is what runs: an equation that is edited in a copy of the package takes effect."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

SOURCE = Path(__file__).parents[2] / "src"

TRAIN = """
import sys, warnings
from pathlib import Path
from mrgs.errors import MrgsWarning
from mrgs.training import make_config, train

scene, output, method, steps, plain = sys.argv[1:]
config = make_config(method, "fast", max_steps=int(steps), resolution=24)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", MrgsWarning)
    unedited = Path(output).with_name("unedited")
    if unedited.exists():
        from mrgs.runs.open import load_run
        run = load_run(unedited, device="cpu")
        run.render_view(run.load_scene().eval[0])
        for warning in caught:
            print("opened:", warning.message)
        caught.clear()
    train(scene, output, config, device="cpu", plain=plain == "plain")
for warning in caught:
    if warning.category is MrgsWarning:
        print(warning.message)
print("numba:", "numba" in sys.modules)
"""

EDITS = {
    "temperature_residuals": (
        "field/heat.py",
        "self.surrounding_weight * surroundings.mean(",
        "self.surrounding_weight * surroundings.amax(",
    ),
    "photometric_loss": (
        "method/losses/photometric.py",
        "(1 - dssim) * (x - y).abs()",
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
    """A copy with its compiled kernels, which Numba knows by the times of the files."""
    shutil.copytree(SOURCE / "mrgs", folder / "mrgs")
    return folder


def trained(
    package: Path, scene: Path, output: Path, steps: int = 20, mode: str = "kernels"
) -> tuple[dict[str, torch.Tensor], list[str]]:
    """The parameters after a training by a copy of the package, and what it printed."""
    command = [sys.executable, "-c", TRAIN, str(scene), str(output), "mrgs", str(steps), mode]
    path = [str(package), *filter(None, sys.path)]
    run = subprocess.run(
        [*command[:2], f"import sys; sys.path[:0] = {path!r}\n{TRAIN}", *command[3:]],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    (checkpoint,) = (output / "checkpoints").glob("*.safetensors")
    return load_file(checkpoint), run.stdout.splitlines()


@pytest.mark.slow
def test_an_edited_equation_runs_in_training_and_in_opened_runs_and_one_line_names_it(
    small_scene, tmp_path
):
    package = copied_package(tmp_path / "source")
    unedited, printed = trained(package, small_scene, tmp_path / "unedited")
    assert printed == ["numba: True"]
    for name, (file, before, after) in EDITS.items():
        path = package / "mrgs" / file
        text = path.read_text(encoding="utf-8")
        assert text.count(before) == 1
        path.write_text(text.replace(before, after), encoding="utf-8")
        model, printed = trained(package, small_scene, tmp_path / name)
        path.write_text(text, encoding="utf-8")

        differs = f"{name}: the kernel differs from the plain definition"
        opened = [line for line in printed if line.startswith("opened: ")]
        assert [line[8:][: len(differs)] for line in opened] == [differs] * (name in RENDERING)
        assert len(printed) == len(opened) + 2
        assert printed[-2].startswith(differs)
        assert not torch.equal(model["gaussians.means"], unedited["gaussians.means"])


@pytest.mark.slow
def test_a_plain_training_needs_no_numba_and_learns_the_same(small_scene, tmp_path):
    by_kernels, _ = trained(SOURCE, small_scene, tmp_path / "kernels", steps=5)
    plain, printed = trained(SOURCE, small_scene, tmp_path / "plain", steps=5, mode="plain")
    assert printed == ["numba: False"]
    for name in ("gaussians.means", "gaussians.sh_dc.rgb", "gaussians.embedding"):
        torch.testing.assert_close(plain[name], by_kernels[name], rtol=1e-3, atol=1e-3)
