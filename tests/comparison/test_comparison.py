"""Whole comparisons of tiny runs; the runs are done in this process, but for one."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from mrgs.errors import MrgsError
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import TrainedRun, open_run
from mrgs.training import train
from mrgs_compare import comparison
from mrgs_compare.comparison import compare
from mrgs_compare.plan import PlannedRun, Variant, plan, run_one
from tests.helpers.comparison import tiny_options
from tests.helpers.runs import made_once


@pytest.fixture
def here(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory, small_scene: Path
) -> list[tuple[str, str]]:
    """Do the runs in this process; the list tells the scene and method of those that were done.
    A new run of the small scene is the copy of one that is done once per session."""
    done: list[tuple[str, str]] = []

    def scored(job: PlannedRun) -> Path:
        key = hashlib.sha256(repr(job.config).encode()).hexdigest()[:16]
        return made_once(
            tmp_path_factory,
            f"scored_{key}",
            lambda folder: run_one(small_scene, folder, job.config),
        )

    def run_jobs(
        jobs: Sequence[PlannedRun], count: int, weights: Path | None, *_: Any
    ) -> dict[PlannedRun, str]:
        failures = {}
        for job in jobs:
            done.append((job.scene_name, job.method))
            if job.scene == small_scene and not job.folder.exists():
                shutil.copytree(scored(job), job.folder)
            try:
                run_one(job.scene, job.folder, job.config, lpips_weights=weights)
            except MrgsError as error:
                failures[job] = str(error)
        return failures

    monkeypatch.setattr(comparison, "run_jobs", run_jobs)
    return done


@pytest.fixture
def twin(small_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_scene, tmp_path / "twin")


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def numbers(line: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", line)]


def files_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The methods of the runs that are opened for the figures, in order; each must be gone when the
    next comes."""
    methods: list[str] = []
    alive: list[weakref.ref[TrainedRun]] = []

    def open_alone(folder: Path, *arguments: Any) -> TrainedRun:
        assert all(reference() is None for reference in alive)
        run = open_run(folder, *arguments)
        methods.append(Path(folder).parent.name)
        alive.append(weakref.ref(run))
        return run

    monkeypatch.setattr(comparison, "open_run", open_alone)
    return methods


@pytest.mark.slow
def test_two_methods_on_two_scenes_with_two_seeds(here, opened, small_scene, twin, tmp_path):
    options = tiny_options(seeds=2, methods=("mrgs-fourier", "mrgs"))
    said: list[str] = []
    result = compare([small_scene, twin], tmp_path / "out", options, say=said.append)
    assert len(here) == 8
    assert result.failures == {}
    assert [numbers(line) for line in said] == [[8, 0]]
    out = tmp_path / "out"
    assert files_in(out / "tables") == {
        f"{name}{suffix}"
        for name in ("thermal", "rgb", "ablation")
        for suffix in (".md", ".tex", ".csv")
    }
    assert re.search(r"\| mrgs \|.* ± ", read(out / "tables" / "thermal.md"))
    results = json.loads(read(out / "results.json"))
    assert len(results["runs"]) == 8
    run = results["runs"][0]
    metrics = json.loads(
        read(out / "runs" / "balls" / "mrgs-fourier" / "seed_0" / "eval" / "metrics.json")
    )
    assert run["figures"]["thermal.psnr"] == metrics["mean"]["thermal"]["psnr"]
    assert run["metrics"] == metrics
    assert "no VGG-16" in run["reasons"]["rgb.lpips"]
    for name in ("qualitative.png", "depth.png"):
        with Image.open(out / "figures" / name) as figure:
            assert figure.width > 900
    assert opened == ["mrgs-fourier", "mrgs"] * 2


def test_what_is_scored_is_not_done_again(here, small_scene, tmp_path):
    first = compare([small_scene], tmp_path / "out", tiny_options(methods=("3dgs-rgbt",)))
    said: list[str] = []
    second = compare([small_scene], tmp_path / "out", tiny_options(), say=said.append)
    assert here == [("balls", "3dgs-rgbt"), ("balls", "mrgs")]
    assert [numbers(line) for line in said] == [[2, 1]]
    assert second.tables[0].rows[0].cells == first.tables[0].rows[0].cells


def test_a_scene_that_has_changed_is_named_before_anything_runs(here, twin, tmp_path):
    out = tmp_path / "out"
    compare([twin], out, tiny_options(methods=("3dgs-rgbt",)))
    tables = read(out / "tables" / "thermal.md")
    bounds = json.loads(read(twin / "temperature_bounds.json"))
    bounds["absolute_max_temperature"] += 10
    (twin / "temperature_bounds.json").write_text(json.dumps(bounds))
    with pytest.raises(MrgsError, match=r"3dgs-rgbt/seed_0 .*temperature range"):
        compare([twin], out, tiny_options(methods=("mrgs", "3dgs-rgbt")))
    assert here == [("twin", "3dgs-rgbt")]
    assert read(out / "tables" / "thermal.md") == tables
    assert len(compare([twin], tmp_path / "new", tiny_options(methods=("mrgs",))).tables) == 2


def test_other_held_out_photos_are_scored_without_training(here, twin, tmp_path):
    out, options = tmp_path / "out", tiny_options(methods=("3dgs-rgbt",))
    first = compare([twin], out, options)
    folder = out / "runs" / "twin" / "3dgs-rgbt" / "seed_0"
    log = read(folder / "log.jsonl")
    for path in (twin / "images").glob("*eval*"):
        with Image.open(path) as photo:
            Image.new(photo.mode, photo.size, "white").save(path)
    said: list[str] = []
    second = compare([twin], out, options, say=said.append)
    assert [numbers(line) for line in said] == [[1, 0]]
    assert read(folder / "log.jsonl") == log
    thermal, rgb = (
        [result.tables[number].rows[0].cells[0].mean for result in (first, second)]
        for number in (0, 1)
    )
    assert thermal[0] == thermal[1]
    assert rgb[0] > rgb[1] + 3
    compare([twin], out, options, say=said.append)
    assert [numbers(line) for line in said[1:]] == [[1, 1]]


def test_a_run_that_was_cut_off_is_continued(here, small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    (job,) = plan([small_scene], tmp_path / "out", options)
    train(small_scene, job.folder, job.config, stop_at=2)
    result = compare([small_scene], tmp_path / "out", options)
    assert result.failures == {}
    assert json.loads(read(job.folder / "eval" / "metrics.json"))["steps"] == 3


def test_a_run_that_fails_leaves_a_dash_with_its_reason(here, small_scene, twin, tmp_path):
    for path in (twin / "images").glob("*train_00003*"):
        path.write_bytes(path.read_bytes()[:200])
    options = tiny_options(methods=("3dgs-rgbt",), max_steps=20)
    result = compare([small_scene, twin], tmp_path / "out", options)
    (failed,) = result.failures
    assert failed.startswith("twin, 3dgs-rgbt")
    text = read(tmp_path / "out" / "tables" / "thermal.md")
    assert "–<sup>a</sup>" in text
    assert re.search(r"<sup>a</sup> .*decoded", text)
    assert (tmp_path / "out" / "figures" / "qualitative.png").is_file()


def test_renders_of_another_program_stand_in_the_tables(here, small_scene, tmp_path):
    for kind, source in (("rgb", "images"), ("thermal", "thermal")):
        shutil.copytree(
            small_scene / source,
            tmp_path / "other" / "balls" / kind,
            ignore=shutil.ignore_patterns("*train*"),
        )
    options = tiny_options(methods=("3dgs-rgbt",))
    result = compare(
        [small_scene], tmp_path / "out", options, renders={"Other": tmp_path / "other"}
    )
    _, theirs = result.tables[0].rows
    assert theirs.labels == ("Other",)
    assert theirs.cells[1].mean == pytest.approx(1.0)
    assert "another program" in theirs.cells[3].note
    assert not (tmp_path / "other" / "balls" / "eval").exists()
    with Image.open(tmp_path / "out" / "figures" / "qualitative.png") as figure:
        assert figure.width > 900


def test_renders_that_are_not_there_are_a_dash(here, small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    result = compare(
        [small_scene], tmp_path / "out", options, renders={"Other": tmp_path / "other"}
    )
    assert list(result.failures) == ["balls, Other"]
    assert "not a folder" in result.failures["balls, Other"]


def test_held_out_photos_that_cannot_be_decoded_are_the_reason_of_every_dash(here, twin, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    compare([twin], tmp_path / "out", options)
    for kind, source in (("rgb", "images"), ("thermal", "thermal")):
        shutil.copytree(
            twin / source,
            tmp_path / "other" / "twin" / kind,
            ignore=shutil.ignore_patterns("*train*"),
        )
    for path in (twin / "images").glob("*eval*"):
        path.write_bytes(path.read_bytes()[:200])
    result = compare([twin], tmp_path / "out", options, renders={"Other": tmp_path / "other"})
    ours, theirs = result.failures
    assert ours.startswith("twin, 3dgs-rgbt")
    assert theirs == "twin, Other"
    assert all("decoded" in reason for reason in result.failures.values())
    assert "decoded" in read(tmp_path / "out" / "tables" / "thermal.md")
    assert files_in(tmp_path / "out" / "figures") == set()  # no photo to show


def test_the_neighbours_alone_have_no_figure(here, opened, small_scene, tmp_path):
    result = compare([small_scene], tmp_path / "out", tiny_options(methods=(), neighbours=(1, 3)))
    assert [table.name for table in result.tables] == ["neighbours"]
    assert not (tmp_path / "out" / "figures").exists()
    assert opened == []


@pytest.mark.slow
def test_a_method_of_the_neighbours_may_stand_in_the_depth_figure(
    here, opened, small_scene, tmp_path
):
    compare(
        [small_scene], tmp_path / "out", tiny_options(methods=("mrgs-fourier",), neighbours=(1, 3))
    )
    assert files_in(tmp_path / "out" / "figures") == {"qualitative.png", "depth.png"}
    assert opened == ["mrgs-fourier", "mrgs"]


def test_a_scene_whose_methods_failed_is_left_out_of_the_figure(here, small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",), neighbours=(1,))
    busy = RunFolder(tmp_path / "out" / "runs" / "balls" / "3dgs-rgbt" / "seed_0")
    with busy.locked():  # as if another process trained there
        result = compare([small_scene], tmp_path / "out", options)
    (failed,) = result.failures
    assert failed.startswith("balls, 3dgs-rgbt")
    assert not (tmp_path / "out" / "figures").exists()


def test_tables_and_figures_of_an_earlier_call_are_removed(here, small_scene, tmp_path):
    out = tmp_path / "out"
    compare([small_scene], out, tiny_options(methods=("mrgs-fourier", "mrgs")))
    for folder in ("tables", "figures"):
        (out / folder / "notes.txt").write_text("mine")
    compare([small_scene], out, tiny_options(methods=("mrgs",)))
    assert {path.split(".")[0] for path in files_in(out / "tables")} == {"thermal", "rgb", "notes"}
    assert files_in(out / "figures") == {"qualitative.png", "notes.txt"}


def test_a_method_named_twice_has_one_row(here, small_scene, tmp_path):
    result = compare([small_scene], tmp_path / "out", tiny_options(methods=("mrgs", "mrgs")))
    assert [[row.labels for row in table.rows] for table in result.tables] == [[("mrgs",)]] * 2


def test_scores_of_an_older_version_are_renewed(here, small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    compare([small_scene], tmp_path / "out", options)
    path = tmp_path / "out" / "runs" / "balls" / "3dgs-rgbt" / "seed_0" / "eval" / "metrics.json"
    older = json.loads(read(path))
    del older["mean"]["thermal"]["psnr_matched"]
    path.write_text(json.dumps(older))
    compare([small_scene], tmp_path / "out", options)
    assert len(here) == 2
    (run,) = json.loads(read(tmp_path / "out" / "results.json"))["runs"]
    assert (
        run["figures"]["thermal.psnr_matched"]
        == run["metrics"]["mean"]["thermal"]["psnr_matched"]
        > 0
    )


def test_a_scored_run_without_checkpoints_is_left_out_of_the_figure(here, small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    compare([small_scene], tmp_path / "out", options)
    shutil.rmtree(tmp_path / "out" / "runs" / "balls" / "3dgs-rgbt" / "seed_0" / "checkpoints")
    result = compare([small_scene], tmp_path / "out", options)
    assert result.tables[0].rows[0].cells[0].mean is not None
    assert files_in(tmp_path / "out" / "figures") == set()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"jobs": 0}, "jobs .* 0"),
        ({"renders": {"mrgs": Path("x")}}, "mrgs: .*already"),
        ({"renders": {"a/b": Path("x")}}, "a/b: .*usable"),
        ({"lpips_weights": Path("none")}, "none: .*safetensors"),
    ],
)
def test_arguments_that_are_not_allowed(arguments, message, small_scene, tmp_path):
    with pytest.raises(MrgsError, match=message):
        compare([small_scene], tmp_path / "out", tiny_options(), **arguments)
    assert not (tmp_path / "out").exists()


def test_a_variant_has_a_row_of_its_own(here, small_scene, tmp_path):
    few = Variant("few", "mrgs", "densification: {max_gaussians: 30}", "few.yaml")
    result = compare(
        [small_scene], tmp_path / "out", tiny_options(methods=("mrgs",), variants=(few,))
    )
    assert [row.labels for row in result.tables[0].rows] == [("mrgs",), ("few",)]
    with pytest.raises(MrgsError, match=r"few: .*already"):
        compare(
            [small_scene], tmp_path / "out", tiny_options(methods=("mrgs",), variants=(few, few))
        )


@pytest.mark.slow
def test_in_a_process_of_its_own(small_scene, tmp_path):
    said: list[str] = []
    result = compare(
        [small_scene], tmp_path / "out", tiny_options(methods=("3dgs-rgbt",)), say=said.append
    )
    assert result.failures == {}
    assert numbers(said[0]) == [1, 0]
    assert said[1].startswith("starts: balls")
    assert said[-1].startswith("scored: balls")
    assert "1 of 1" in said[-1]
    assert isinstance(result.tables[0].rows[0].cells[0].mean, float)
