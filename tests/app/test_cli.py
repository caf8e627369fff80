"""The command line as its user sees it: what is printed, what is written, and how it ends."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from filelock import FileLock
from PIL import Image
from safetensors.torch import save_file

from mrgs.app import cli, commands, progress, terminal
from mrgs.app.cli import how_to_read, main
from mrgs.training import StepStatistics
from mrgs_compare.table import Cell, Group, Row, Table
from tests.helpers.scenes import write_scene

TINY = ("--max-steps", "3", "--max-gaussians", "100")
TRAINED = "frame_train_00003.png"
"""A training image of the scene in tests/conftest.py."""

Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def trained(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; only to be read."""
    output = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", str(small_scene), "--output", str(output), *TINY]) == 0
    return output


@pytest.fixture
def own_run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be damaged."""
    return shutil.copytree(trained, tmp_path / "own run")


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture[str], message: str, *arguments: object) -> None:
    """The command ends with code 2 and exactly one line on stderr, which matches ``message``."""
    capsys.readouterr()
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("mrgs: error: ")
    assert error.count("\n") == 1
    assert error.endswith("\n")
    assert re.search(message, error), error


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def transforms(change: Callable[[dict], object]) -> Damage:
    return lambda scene: edit_json(scene / "transforms.json", change)


def cut_off(name: str) -> Damage:
    return lambda scene: (scene / name).write_bytes((scene / name).read_bytes()[:200])


def set_pose(entry: float) -> Damage:
    def change(content: dict) -> None:
        content["frames"][1]["transform_matrix"][0][0] = entry

    return transforms(change)


def hold_everything_out(content: dict) -> None:
    content.update(
        train_filenames=[], val_filenames=[frame["file_path"] for frame in content["frames"]]
    )


BAD_SCENES: dict[str, tuple[Damage, str]] = {
    "folder missing": (
        shutil.rmtree,
        r"scene: not a folder",
    ),
    "transforms missing": (
        lambda scene: (scene / "transforms.json").unlink(),
        r"scene: .*looked for transforms\.json",
    ),
    "transforms damaged": (
        lambda scene: (scene / "transforms.json").write_text("{"),
        r"transforms\.json: .*JSON",
    ),
    "no frames": (
        transforms(lambda content: content.update(frames=[])),
        r"\"frames\" is \[\]",
    ),
    "image missing": (
        lambda scene: (scene / "images" / TRAINED).unlink(),
        rf"transforms\.json: .*'images/{TRAINED}' of frame 3 .*restore",
    ),
    "image truncated": (
        cut_off(f"images/{TRAINED}"),
        rf"{TRAINED}: .*truncated",
    ),
    "thermal truncated": (cut_off(f"thermal/{TRAINED}"), rf"thermal/{TRAINED}: .*decoded"),
    "image of another size": (
        lambda scene: Image.new("RGB", (20, 10)).save(scene / "images" / TRAINED),
        rf"{TRAINED}: .*20×10 px.*40×30 px",
    ),
    "large image": (
        lambda scene: Image.new("1", (10_000, 9_500)).save(scene / "images" / TRAINED),
        rf"{TRAINED}: .*25 megapixels",
    ),
    "decompression bomb": (
        lambda scene: Image.new("1", (20_000, 10_000)).save(scene / "images" / TRAINED),
        rf"{TRAINED}: .*25 megapixels",
    ),
    "NaN in a pose": (
        set_pose(float("nan")),
        r"transforms\.json: transform_matrix of frame 1 .*nan",
    ),
    "scaled pose": (
        set_pose(3.0),
        r"transform_matrix of frame 1 .*rotation",
    ),
    "zero focal length": (
        transforms(lambda content: content.update(fl_x=0)),
        r"transforms\.json: .*focal length of frame 0 .*positive",
    ),
    "no training views": (
        transforms(hold_everything_out),
        r"transforms\.json: .*split lists",
    ),
    "path leaves": (
        transforms(lambda content: content["frames"][1].update(file_path="../../secret.png")),
        r"'../../secret\.png' leaves",
    ),
    "absolute path": (
        transforms(lambda content: content["frames"][1].update(file_path="/etc/secret.png")),
        r"'/etc/secret\.png' leaves",
    ),
    "one temperature": (
        lambda scene: edit_json(
            scene / "temperature_bounds.json", lambda c: c.update(absolute_min_temperature=30)
        ),
        r"temperature_bounds\.json: .*30\.0 to 30\.0",
    ),
    "start points damaged": (
        lambda scene: (scene / "sparse_pc.ply").write_text("ply\n"),
        r"sparse_pc\.ply: .*export",
    ),
}


@pytest.mark.filterwarnings(
    "default"
)  # as at the terminal, where another library's warning would be a second line
@pytest.mark.parametrize(("damage", "message"), BAD_SCENES.values(), ids=BAD_SCENES)
def test_a_bad_scene_is_one_line_and_leaves_nothing(damage, message, tmp_path, capsys):
    scene = write_scene(tmp_path / "scene")
    damage(scene)
    refused(capsys, message, "train", scene, "--output", tmp_path / "run", *TINY)
    assert not (tmp_path / "run").exists()


def test_what_stood_in_the_output_folder_stays(tmp_path, capsys):
    scene, output = write_scene(tmp_path / "scene"), tmp_path / "run"
    cut_off(f"images/{TRAINED}")(scene)
    output.mkdir()
    for name, message in (
        ("survey.yaml", "cannot be decoded"),
        ("notes.txt", r"\(notes\.txt\): .*\(--output\)"),
    ):
        (output / name).write_text("mine")
        refused(capsys, message, "train", scene, "--output", output, *TINY)
    assert {path.name for path in output.iterdir()} == {"survey.yaml", "notes.txt"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--method", "nerf"), "method 'nerf'; .*mrgs-plus, mrgs,"),
        (("--preset", "slow"), "preset 'slow'; .*fast, default, paper"),
        (("--max-steps", 0), "max_steps .*at least 1,"),
        (("--max-gaussians", 0), "max_gaussians .*1,000,000,000"),
        (("--resolution", 3), "resolution .*16 px"),
        (("--seed", -1), "seed .*at least 0,"),
        (("--seed", 2**70), "seed .*4,294,967,295"),
        (
            ("--config", "nowhere.yaml"),
            r"nowhere\.yaml: .*No such file",
        ),
        (("--config", "/"), r"/: .*Is a directory"),
    ],
)
def test_a_bad_option_is_one_line_and_leaves_nothing(
    options, message, small_scene, tmp_path, capsys
):
    refused(capsys, message, "train", small_scene, "--output", tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()


def test_a_malformed_option_is_refused_by_name(small_scene, capsys):
    for option in ("--max-steps", "--device"):
        with pytest.raises(SystemExit, match="2"):
            run("train", small_scene, option, "many")
        assert option in capsys.readouterr().err


def test_swapped_bounds_are_mended_and_said_once(tmp_path, capsys):
    scene = write_scene(tmp_path / "scene")
    bounds = {"absolute_min_temperature": 30.0, "absolute_max_temperature": 10.0}
    (scene / "temperature_bounds.json").write_text(json.dumps(bounds))
    assert run("train", scene, "--output", tmp_path / "run", *TINY) == 0
    printed = capsys.readouterr()
    (note,) = printed.err.splitlines()
    assert note.startswith("mrgs: note: ")
    for part in ("temperature_bounds.json", "swapped", "10 °C to 30 °C"):
        assert part in note
    assert "bounds swapped" not in printed.out
    assert " °C | " in printed.out


def test_without_bounds_it_trains_without_celsius_and_says_so(tmp_path, capsys):
    scene, output = write_scene(tmp_path / "scene"), tmp_path / "run"
    (scene / "temperature_bounds.json").unlink()
    assert run("train", scene, "--output", output, *TINY) == 0
    printed = capsys.readouterr()
    assert "temperature_bounds.json" in printed.err
    assert "relative" in printed.err
    assert re.search(r"thermal error \d\.\d{3} \(normalised\)", printed.out)
    assert run("eval", output) == 0
    assert "°C" not in capsys.readouterr().out
    assert (
        json.loads((output / "eval" / "metrics.json").read_text())["mean"]["thermal"]["mae_c"]
        is None
    )
    assert run("render", output) == 0
    assert (output / "renders" / "eval" / "thermal_normalised" / "frame_eval_00002.tiff").is_file()
    assert not (output / "renders" / "eval" / "temperature_c").exists()


def test_an_output_folder_in_use_is_left_alone(small_scene, tmp_path, capsys):
    output = tmp_path / "run"
    output.mkdir()
    with FileLock(output / ".lock"):
        refused(capsys, r"in use .*\(--output\)", "train", small_scene, "--output", output, *TINY)
    assert not (output / "config.yaml").exists()


def test_an_output_folder_that_holds_a_run_is_left_alone(own_run, small_scene, capsys):
    before = (own_run / "log.jsonl").read_bytes()
    message = r"own run already .*\(--resume, --output\)"
    refused(capsys, message, "train", small_scene, "--output", own_run, *TINY)
    assert (own_run / "log.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "flags"),
    [
        (("--max-steps", 400, "--method", "3dgs-rgbt"), "--method, --max-steps"),
        (("--max-gaussians", 7, *TINY[:2]), "--max-gaussians"),
        (("--seed", 4), "--seed"),
        (("--preset", "paper"), "--preset"),
    ],
)
def test_a_resumed_run_takes_no_other_settings(options, flags, own_run, small_scene, capsys):
    message = rf"own run is resumed .*\({flags}, --output\)"
    resume = ("train", small_scene, "--resume", "--output", own_run)
    refused(capsys, message, *resume, *options)


def test_a_finished_run_says_so_and_may_be_given_its_own_settings(own_run, small_scene, capsys):
    resume = ("train", small_scene, "--resume", "--output", own_run)
    for options in ((), TINY):
        assert run(*resume, *options) == 0
        assert "already finished" in capsys.readouterr().out


def test_a_run_that_died_before_its_first_checkpoint_can_be_begun_anew(own_run, small_scene):
    shutil.rmtree(own_run / "checkpoints")
    assert run("train", small_scene, "--output", own_run, *TINY) == 0


@pytest.mark.parametrize("name", ["file", "file/run"])
def test_an_output_folder_that_cannot_be_made_is_named(name, small_scene, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    message = rf"{name} .*written .*\(--output\)"
    refused(capsys, message, "train", small_scene, "--output", tmp_path / name, *TINY)


def cut_checkpoint(folder: Path) -> None:
    checkpoint = next((folder / "checkpoints").iterdir())
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])


BAD_RUNS: dict[str, tuple[Damage, str]] = {
    "missing": (
        shutil.rmtree,
        r"own run .*no config\.yaml.*`mrgs train`",
    ),
    "no configuration": (
        lambda folder: (folder / "config.yaml").unlink(),
        r"no config\.yaml",
    ),
    "not YAML": (
        lambda folder: (folder / "config.yaml").write_text("max_steps: [1"),
        r"config\.yaml .*YAML",
    ),
    "no method": (
        lambda folder: (folder / "config.yaml").write_text("max_steps: 5"),
        r"config\.yaml names no method",
    ),
    "bad value": (
        lambda folder: (folder / "config.yaml").write_text("method: mrgs\nmax_steps: 0"),
        r"config\.yaml: max_steps .*at least 1",
    ),
    "no text": (
        lambda folder: (folder / "config.yaml").write_bytes(b"\xff\xfe\0"),
        r"config\.yaml .*read",
    ),
    "no checkpoint": (
        lambda folder: shutil.rmtree(folder / "checkpoints"),
        "no checkpoint yet",
    ),
    "checkpoint truncated": (
        cut_checkpoint,
        r"own run .*whole.*restore",
    ),
}


@pytest.mark.parametrize(("damage", "message"), BAD_RUNS.values(), ids=BAD_RUNS)
def test_a_bad_run_is_one_line_for_every_command(damage, message, own_run, small_scene, capsys):
    damage(own_run)
    refused(capsys, message, "train", small_scene, "--resume", "--output", own_run)
    for command in ("eval", "render", "export", "report", "view"):
        refused(capsys, message, command, own_run)
    for name in ("eval", "renders", "export", "report.html"):
        assert not (own_run / name).exists()
    assert capsys.readouterr().out == ""


def test_a_scene_that_has_moved_is_named(tmp_path, capsys):
    scene, output = write_scene(tmp_path / "scene"), tmp_path / "run"
    run("train", scene, "--output", output, *TINY)
    scene.rename(tmp_path / "elsewhere")
    for command in ("eval", "render", "export", "report"):
        refused(
            capsys,
            r"/scene: .*/run .*no longer there",
            command,
            output,
        )
    assert run("eval", output, "--scene", tmp_path / "elsewhere") == 0
    refused(
        capsys,
        "elsewhere2: not a folder",
        "train",
        tmp_path / "elsewhere2",
        "--resume",
        "--output",
        output,
    )
    assert run("train", tmp_path / "elsewhere", "--resume", "--output", output) == 0


def test_without_eval_views_there_is_nothing_to_score(tmp_path, capsys):
    scene, output = write_scene(tmp_path / "scene"), tmp_path / "run"
    edit_json(scene / "transforms.json", lambda content: content.update(val_filenames=[]))
    run("train", scene, "--output", output, *TINY)
    refused(
        capsys,
        r"/scene: .*held out.*'eval'",
        "eval",
        output,
    )
    assert not (output / "eval").exists()
    refused(
        capsys,
        r"/scene: .*held out.*\(--split\)",
        "render",
        output,
    )
    assert not (output / "renders").exists()


def test_bad_lpips_weights_are_named(trained, tmp_path, capsys):
    file = tmp_path / "weights.safetensors"
    refused(
        capsys,
        r"weights\.safetensors: no such file.*\(--lpips-weights\)",
        "eval",
        trained,
        "--lpips-weights",
        file,
    )
    file.write_bytes(b"PK\x03\x04" * 100)
    refused(
        capsys,
        r"weights\.safetensors: not a readable",
        "eval",
        trained,
        "--lpips-weights",
        file,
    )
    save_file({"x": torch.zeros(1)}, file)
    refused(capsys, r"features\.0\.weight", "eval", trained, "--lpips-weights", file)


def test_a_path_needs_frames(own_run, capsys):
    refused(
        capsys,
        "frames must be 1 to .*--frames",
        "render",
        own_run,
        "--split",
        "path",
        "--frames",
        0,
    )
    assert not (own_run / "renders").exists()


@pytest.mark.slow
def test_synth_keeps_what_is_there(small_scene, tmp_path, capsys):
    pytest.importorskip("mitsuba")
    refused(
        capsys,
        "holds a scene already",
        "synth",
        small_scene,
    )
    refused(
        capsys,
        "seed .*1,000,000",
        "synth",
        tmp_path / "new",
        "--seed",
        -1,
    )
    refused(
        capsys,
        "15×240",
        "synth",
        tmp_path / "new",
        "--width",
        15,
    )
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_synth_without_mitsuba_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    refused(capsys, r'pip install .*"\.\[synth\]"', "synth", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def interrupt(monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    """Press Ctrl-C when the training starts."""
    start = progress.TrainingProgress.start

    def pressed(self, *arguments):
        start(self, *arguments)
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(progress.TrainingProgress, "start", pressed)


def test_a_flat_field_that_cannot_be_used_is_refused(small_scene, tmp_path, capsys):
    np.savetxt(tmp_path / "frame.csv", np.full((12, 16), 20.0), delimiter=",")
    train = ("train", small_scene, "--output", tmp_path / "run", "--flat-field", tmp_path)
    refused(capsys, r"16×12 px, .*same camera.*--flat-field", *train)
    refused(capsys, "mrgs-plus", *train, "--method", "mrgs")
    refused(capsys, "keeps its shading", *train, "--resume")
    refused(capsys, "furlongs.*--flat-field-unit", *train, "--flat-field-unit", "furlongs")
    refused(capsys, "needs --flat-field", "train", small_scene, "--flat-field-unit", "kelvin")


def test_ctrl_c_leaves_a_checkpoint_and_resume_finishes(small_scene, tmp_path, monkeypatch, capsys):
    output = tmp_path / "my run"
    before = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        interrupt(patch, times=1)
        assert run("train", small_scene, "--output", output, *TINY) == 130
    printed = capsys.readouterr()
    assert f"train {small_scene} --output '{output}' --resume" in printed.out
    assert "after this step" in printed.err
    assert printed.err.endswith("mrgs: stopped\n")
    assert signal.getsignal(signal.SIGINT) is before
    assert [path.name for path in (output / "checkpoints").iterdir()] == ["step_000001.safetensors"]
    assert run("train", small_scene, "--output", output, "--resume") == 0
    assert f"eval '{output}'" in capsys.readouterr().out
    assert (output / "checkpoints" / "step_000003.safetensors").is_file()


def test_ctrl_c_in_the_last_step_is_a_finished_run(small_scene, tmp_path, monkeypatch, capsys):
    interrupt(monkeypatch, times=1)
    assert (
        run(
            "train",
            small_scene,
            "--output",
            tmp_path / "run",
            "--max-steps",
            1,
            "--max-gaussians",
            100,
        )
        == 0
    )
    assert "next: mrgs eval" in capsys.readouterr().out


def test_a_second_ctrl_c_stops_at_once_and_leaves_nothing(
    small_scene, tmp_path, monkeypatch, capsys
):
    interrupt(monkeypatch, times=2)
    assert run("train", small_scene, "--output", tmp_path / "run", *TINY) == 130
    assert capsys.readouterr().err.endswith("mrgs: stopped\n")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_real_process_stops_at_ctrl_c_and_refuses_bad_input(small_scene, tmp_path):
    command = [
        sys.executable,
        "-m",
        "mrgs.app.cli",
        "train",
        str(small_scene),
        "--output",
        str(tmp_path / "run"),
    ]
    options = ["--max-steps", "1000000", "--max-gaussians", "100"]
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        while "start points" not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "mrgs train" in out
    assert "Traceback" not in error
    again = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert (again.returncode, again.stdout) == (2, "")
    assert re.fullmatch(r"mrgs: error: .*already holds a run.*\n", again.stderr)


SCENES = {
    "both": {},
    "two cameras": {"two_cameras": True},
    "thermal": {"rgb": False},
    "RGB": {"thermal": False},
}


RARE_SCENES = [pytest.param(each, marks=pytest.mark.slow) for each in ("two cameras", "RGB")]


@pytest.mark.parametrize("kind", ["both", "thermal", "masks", *RARE_SCENES])
def test_train_eval_and_render(kind, tmp_path, capsys):
    scene, output = write_scene(tmp_path / "scene", **SCENES.get(kind, {})), tmp_path / "run"
    if kind == "masks":
        mask = np.full((30, 40), 255, np.uint8)
        mask[:, :10] = 0
        for folder, images in (("masks", "images"), ("thermal_masks", "thermal")):
            (scene / folder).mkdir()
            for image in (scene / images).iterdir():
                Image.fromarray(mask).save(scene / folder / image.name)
    has_rgb, has_thermal = kind != "thermal", kind != "RGB"
    assert run("train", scene, "--output", output, *TINY) == 0
    numbers = re.search(r"^scene: (.*)", capsys.readouterr().out, re.MULTILINE)
    assert re.findall(r"\d+", numbers[1]) == ["6", "2", "25"]  # training, held out, start points
    assert run("eval", output) == 0
    printed = capsys.readouterr()
    assert ("thermal: PSNR" in printed.out, "RGB:     PSNR" in printed.out) == (
        has_thermal,
        has_rgb,
    )
    assert bool(re.search(r"MAE \d+\.\d{3} °C", printed.out)) == has_thermal
    assert {path.name for path in (output / "eval").iterdir()} == {
        "metrics.json",
        "metrics.md",
        "contact_sheet.png",
    }
    assert len(json.loads((output / "eval" / "metrics.json").read_text())["views"]) == 2
    assert run("render", output, "--palette", "iron") == 0
    check_renders(output / "renders" / "eval", has_rgb, has_thermal)
    assert run("render", output, "--split", "path", "--frames", 2) == 0
    folders = {"rgb"} & {"rgb" if has_rgb else ""} | {"thermal"} & {
        "thermal" if has_thermal else ""
    }
    path = output / "renders" / "path"
    assert {folder.name for folder in path.iterdir() if folder.is_dir()} == folders
    for folder in folders:
        assert sorted(frame.name for frame in (path / folder).iterdir()) == [
            "00000.png",
            "00001.png",
        ]
    assert capsys.readouterr().err == ""


def check_renders(folder: Path, has_rgb: bool, has_thermal: bool) -> None:
    """Every image of a view, of the right kind, and none of what the scene does not have."""
    view = "frame_eval_00002"
    kinds = {"rgb": has_rgb, "depth_rgb": has_rgb}
    kinds |= {"thermal": has_thermal, "temperature_c": has_thermal, "depth_thermal": has_thermal}
    assert {path.name for path in folder.iterdir()} == {
        name for name, there in kinds.items() if there
    }
    if has_rgb:
        with Image.open(folder / "rgb" / f"{view}.png") as image:
            assert (image.mode, image.size) == ("RGB", (40, 30))
    if has_thermal:
        with Image.open(folder / "temperature_c" / f"{view}.tiff") as image:
            celsius = np.asarray(image)
        assert (celsius.dtype, celsius.shape) == (np.float32, (30, 40))
        assert 10 <= celsius.min() < celsius.max() < 40
    with Image.open(
        folder / ("depth_rgb" if has_rgb else "depth_thermal") / f"{view}.tiff"
    ) as image:
        depth = np.asarray(image)
    assert (depth.dtype, depth.shape) == (np.float32, (30, 40))
    surface = depth[np.isfinite(depth)]  # three steps may leave all of it half transparent
    assert ((surface > 0) & (surface < 10)).all()


@pytest.mark.filterwarnings("ignore::mrgs.errors.MrgsWarning")
def test_renders_of_another_program_are_scored(small_scene, tmp_path, capsys):
    own_run = tmp_path / "own run"
    run("train", small_scene, "--output", own_run, "--method", "mrgs", *TINY)
    run("render", own_run)
    renders = own_run / "renders" / "eval"
    assert run("eval", small_scene, "--renders", renders) == 0
    assert "thermal: " in capsys.readouterr().out
    assert run("eval", own_run) == 0
    own, other = (
        json.loads((folder / "eval" / "metrics.json").read_text()) for folder in (own_run, renders)
    )
    assert other["mean"]["thermal"]["psnr"] == pytest.approx(
        own["mean"]["thermal"]["psnr"], abs=1e-3
    )
    assert other["mean"]["rgb"]["psnr"] == pytest.approx(own["mean"]["rgb"]["psnr"], abs=0.2)
    refused(capsys, "holds no renderings", "eval", small_scene, "--renders", own_run)
    refused(
        capsys,
        "omit --scene",
        "eval",
        small_scene,
        "--renders",
        renders,
        "--scene",
        small_scene,
    )
    refused(capsys, "--resolution needs --renders", "eval", own_run, "--resolution", "30")


@pytest.mark.slow
def test_methods_are_compared(small_scene, tmp_path, capsys):
    tiny = ("--max-steps", "2", "--max-gaussians", "60", "--output", tmp_path / "compare")
    assert run("compare", small_scene, "--methods", "mrgs-plus", *tiny) == 0
    printed = capsys.readouterr().out
    assert "--seeds 3" in printed
    assert "second best" not in printed, "nothing is ranked"
    assert "PSNR, dB" in printed
    assert (tmp_path / "compare" / "tables" / "thermal.md").is_file()
    refused(capsys, "use NAME=PATH", "compare", small_scene, *tiny, "--renders", "somewhere")
    refused(capsys, "a is used twice", "compare", small_scene, *tiny, "--renders", "a=b", "a=c")
    refused(
        capsys, "no.yaml: cannot be read", "compare", small_scene, *tiny, "--variants", "a=no.yaml"
    )


def test_the_signs_in_printed_tables_are_explained():
    rows = tuple(Row((name,), (Cell(value),)) for name, value in (("a", 30.0), ("b", 29.0)))
    table = Table("t", "T", ("",), (Group("", ("thermal.psnr",)),), rows)
    (legend,) = how_to_read([table], seeds=3)
    assert legend.startswith("*: ")
    assert "+: " in legend
    assert how_to_read([table], seeds=1)[0] == legend
    assert how_to_read([dataclasses.replace(table, rows=rows[:1])], seeds=3) == []


@pytest.mark.slow
def test_a_radiance_field_is_trained_and_scored_but_not_exported(small_scene, tmp_path, capsys):
    output = tmp_path / "nerf"
    options = ("--method", "thermonerf", "--output", output, "--max-steps", "2")
    message = "--max-gaussians needs"
    refused(capsys, message, "train", small_scene, *options, "--max-gaussians", 9)
    assert run("train", small_scene, *options) == 0
    assert run("train", small_scene, "--output", output, "--resume") == 0
    assert run("eval", output) == 0
    assert json.loads((output / "eval" / "metrics.json").read_text())["gaussians"] is None
    refused(
        capsys,
        "run of thermonerf",
        "export",
        output,
    )


def test_every_scene_and_camera_of_the_generator_has_its_option():
    from mrgs_synth import CameraName, SceneKind

    offered = get_type_hints(commands.Synth)
    assert get_args(offered["scene"]) == (*get_args(SceneKind), "solar-plant")
    assert get_args(offered["camera"]) == get_args(CameraName)


def test_export_and_report(own_run, capsys):
    assert run("export", own_run, "--format", "ply") == 0
    out = capsys.readouterr().out
    assert re.search(
        r"^quality loss of the export: RGB -?\d+\.\d\d dB, thermal -?\d+\.\d\d dB$",
        out,
        re.MULTILINE,
    )
    assert re.search(r"^export 2 of 2: ply \| 0:0\d left$", out, re.MULTILINE)
    assert (own_run / "export" / "rgb_thermal.ply").read_bytes().startswith(b"ply\n")
    assert (
        run(
            "export", own_run, "--format", "page", "--output", own_run / "mail", "--palette", "iron"
        )
        == 0
    )
    page = own_run / "mail" / "page.html"
    assert capsys.readouterr().out.endswith(f"open:  {page} (in a browser)\n")
    assert run("report", own_run) == 0
    said = capsys.readouterr().out
    assert re.search(r"^report 3 of 3: page \| 0:\d\d left$", said, re.MULTILINE)
    assert "Limits of the measurement" in (own_run / "report.html").read_text(encoding="utf-8")


def test_the_range_of_an_export_must_rise(own_run, capsys):
    refused(capsys, "", "export", own_run, "--format", "ply", "--range-c", 30, 20)


def test_an_unfinished_run_is_used_and_said(small_scene, tmp_path, monkeypatch, capsys):
    output = tmp_path / "run"
    interrupt(monkeypatch, times=1)
    run("train", small_scene, "--output", output, *TINY)
    capsys.readouterr()
    run("export", output, "--format", "spz")
    assert "step 1 of 3" in capsys.readouterr().err


def test_view_serves_and_says_where_to_look(own_run, monkeypatch, capsys):

    def serve(run_, scene, host, port, on_ready) -> None:
        assert (scene.name, host, port) == (run_.load_scene().name, "127.0.0.1", 0)
        on_ready("http://127.0.0.1:4711")

    monkeypatch.setattr("mrgs.viewer.view", serve)
    assert run("view", own_run, "--port", 0) == 0
    assert "http://127.0.0.1:4711" in capsys.readouterr().out


def test_a_training_can_be_watched(small_scene, tmp_path, capsys):
    assert (
        run("train", small_scene, "--output", tmp_path / "run", "--view", "--port", 0, *TINY) == 0
    )
    assert re.search(r"open http://127\.0\.0\.1:\d+", capsys.readouterr().out)


def test_a_transforms_file_names_the_scene_too(tmp_path, monkeypatch):
    scene = write_scene(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    assert run("train", scene / "transforms.json", *TINY) == 0
    assert run("eval", "runs/scene-mrgs-plus") == 0
    assert (
        json.loads(Path("runs/scene-mrgs-plus/eval/metrics.json").read_text())["scene"] == "scene"
    )


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 4 GiB"), "GPU's"),
        (RuntimeError("CUBLAS_STATUS_ALLOC_FAILED when calling"), "GPU's"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), "the system"),
        (MemoryError(), "the system"),
    ],
)
def test_a_lack_of_memory_is_one_line(error, message):
    assert message in cli._line(error)


def test_progress_is_plain_lines_where_there_is_no_terminal(small_scene, tmp_path, capsys):
    assert run("train", small_scene, "--output", tmp_path / "run", *TINY) == 0
    printed = capsys.readouterr().out
    assert "\r" not in printed
    assert "\033" not in printed
    last = [line for line in printed.splitlines() if line.startswith("step ")][-1]
    assert re.search(r"step 3/3 \| 0:00 left \|.* steps/s$", last)
    assert re.search(r"\| loss 0\.\d{4} \| thermal error \d+\.\d\d °C \| 25 Gaussians", last)


def test_progress_is_one_line_on_a_terminal(small_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")
    assert run("train", small_scene, "--output", tmp_path / "run", *TINY) == 0
    bars = [line for line in capsys.readouterr().out.split("\n") if "step 3/3" in line]
    assert len(bars) == 1
    drawn = [re.sub(r"\033\[[\d;?]*\w", "", part) for part in bars[0].split("\r")]
    assert "step 3/3" in drawn[-1]
    assert all(len(part) <= 60 for part in drawn)
    assert run("eval", tmp_path / "run") == 0
    out = capsys.readouterr().out
    assert out.index("scoring 1/2") < out.index("scoring 2/2")
    assert out.count("\033[?25l") == out.count("\033[?25h") == 1, "the cursor comes back"


def test_time_left_is_readable():
    assert [progress.duration(seconds) for seconds in (0.4, 75, 3600, 45_296)] == [
        "0:00",
        "1:15",
        "1:00:00",
        "12:34:56",
    ]


NO_GPU = r"; or use the CPU \(--device\)$"


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "SCENE", "--output", "NEW"),
        ("eval", "RUN"),
        ("render", "RUN"),
        ("report", "RUN"),
        ("export", "RUN", "--output", "NEW"),
        ("demo", "--output", "NEW"),
        ("compare", "SCENE", "--output", "NEW"),
    ],
)
def test_a_gpu_that_cannot_be_used_is_refused(arguments, small_scene, own_run, tmp_path, capsys):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    places = {"SCENE": small_scene, "RUN": own_run, "NEW": tmp_path / "new"}
    refused(capsys, NO_GPU, *(places.get(each, each) for each in arguments), "--device", "cuda")
    assert not (tmp_path / "new").exists()


def test_thermonerf_says_that_it_works_on_the_cpu_alone(small_scene, tmp_path, capsys):
    options = ("--method", "thermonerf", "--output", tmp_path / "new", "--device", "cuda")
    refused(
        capsys,
        "thermonerf .*--device",
        "train",
        small_scene,
        *options,
    )


def test_the_cpu_can_be_asked_for_and_is_noted(small_scene, tmp_path):
    assert run("train", small_scene, "--output", tmp_path / "run", "--device", "cpu", *TINY) == 0
    assert run("eval", tmp_path / "run", "--device", "cpu") == 0
    assert json.loads((tmp_path / "run/eval/metrics.json").read_text())["device"] == "cpu"


def test_a_gpu_that_is_used_is_named(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "NVIDIA H200")
    terminal.note_gpu(torch.device("cpu"))
    assert capsys.readouterr().out == ""
    terminal.note_gpu(torch.device("cuda", 0))
    assert "NVIDIA H200\n" in capsys.readouterr().out


def test_what_steps_measured_is_read_only_when_a_line_is_shown(capsys):
    """On a GPU, to read is to wait."""
    now = [0.0]
    read: list[int] = []

    class Step(StepStatistics):
        def _read(self) -> list[float]:
            read.append(self.step)
            return super()._read()

    shown = progress.TrainingProgress(clock=lambda: now[0])
    for number in (1, 2):
        shown.step(Step(number, 0.5, {}, 0.25, 10, False))
    assert read == []
    now[0] = 60.0
    shown.step(Step(3, 0.5, {}, 0.25, 10, False))
    assert set(read) == {1, 2, 3}
    (line,) = capsys.readouterr().out.splitlines()
    assert "0.5000" in line
    assert "0.250 (normalised)" in line


def test_the_scene_generator_needs_a_checkout(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mrgs_synth", None)
    assert main(["synth", str(tmp_path / "scene")]) == 2
    assert "source checkout" in capsys.readouterr().err


def test_minutes_choose_the_number_of_steps(small_scene, tmp_path, capsys):
    """Of so few, the pilot leaves none: one step is taken all the same."""
    output = tmp_path / "run"
    options = ("--max-gaussians", 60, "--output", output, "--minutes", 0.01)
    assert run("train", small_scene, *options) == 0
    assert re.search(r"\b1 steps .*0\.01 min\n", capsys.readouterr().out)
    assert "\nmax_steps: 1\n" in (output / "config.yaml").read_text()


@pytest.mark.parametrize("other", [("--max-steps", 3), ("--resume",)])
def test_minutes_leave_no_other_choice_of_steps(other, trained, small_scene, capsys):
    message = "--minutes .*--resume and --max-steps"
    options = ("--output", trained, "--minutes", 1, *other)
    refused(capsys, message, "train", small_scene, *options)


def test_minutes_and_scoring_exclude_each_other(small_scene, tmp_path, capsys):
    options = ("--output", tmp_path / "run", "--minutes", 1, "--eval-steps", 2)
    refused(capsys, "--minutes .*--eval-steps .*--max-steps", "train", small_scene, *options)


def test_minutes_are_above_zero(small_scene, tmp_path, capsys):
    options = ("--output", tmp_path / "run", "--minutes", 0)
    refused(capsys, "--minutes .*above 0", "train", small_scene, *options)


def test_minutes_and_a_file_with_steps(small_scene, tmp_path, capsys):
    config = tmp_path / "own.yaml"
    config.write_text("{max_steps: 2}")
    options = ("--output", tmp_path / "run", "--minutes", 1, "--config", config)
    message = f"--minutes .*max_steps .*{config}"
    refused(capsys, message, "train", small_scene, *options, "--max-gaussians", 50)
