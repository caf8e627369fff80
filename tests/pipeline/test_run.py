"""The pipeline from a folder to results: what is done, kept, repeated and refused."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

from mrgs import load_run, open_marks
from mrgs.errors import ConfigError, MrgsError, MrgsWarning, RunError, SceneError
from mrgs.marks import Mark, Marks
from mrgs.pipeline import Monitor, PipelinePlan, PlannedStage, run_pipeline
from mrgs.pipeline import run as run_module
from mrgs.pipeline import stages as stages_module
from mrgs.pipeline.plan import QUALITIES, Quality, take_in
from mrgs.pipeline.stages import LEDGER
from mrgs.prepare import Preparation, PrepareOptions, StageReport
from mrgs.survey import SURVEY_FILE, Survey, read_survey, write_survey
from tests.helpers.photos import photo
from tests.helpers.scenes import write_scene

SPOT = Mark("H1", "spot", ((0.0, 0.0, 0.0),), (0.0, 3.0, 0.0), radius=0.1)
STAGES = ["check", "train", "score", "render", "report", "page", "exports"]


class Watcher(Monitor):
    """Notes what happens; accepts warnings; stops when a stage begins.

    Args:
        stop_at: the stage.
    """

    def __init__(self, stop_at: str = "", accept: bool = True) -> None:
        self.stop_at, self.accept = stop_at, accept
        self.ran: list[str] = []
        self.reused_stages: list[str] = []
        self.left: list[float | None] = []
        self.plan: PipelinePlan | None = None
        self.warnings: Sequence[str] = ()

    def planned(self, plan: PipelinePlan) -> None:
        self.plan = plan

    def reused(self, stage: PlannedStage) -> None:
        self.reused_stages.append(stage.name)

    @contextmanager
    def running(self, stage: PlannedStage, rest_s: float) -> Iterator[None]:
        assert rest_s >= 0
        if stage.name == self.stop_at:
            raise KeyboardInterrupt
        yield
        self.ran.append(stage.name)

    def progress(self, part: str, done: int, total: int, left_s: float | None) -> None:
        self.left.append(left_s)

    def accepts(self, warnings: Sequence[str], page: Path) -> bool:
        assert page.is_file()
        self.warnings = warnings
        return self.accept


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Qualities that take seconds."""
    for name, steps in (("fast", 2), ("default", 3), ("best", 4)):
        monkeypatch.setitem(QUALITIES, name, Quality(name, "fast", steps, 100, 640))


@pytest.fixture(scope="module")
def finished(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished pipeline in a relative folder, stopped before each stage and continued by the
    same call."""
    output = tmp_path_factory.mktemp("pipeline") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(output.parent)
        patch.setitem(QUALITIES, "fast", Quality("fast", "fast", 2, 100, 640))
        for index, stage in enumerate(STAGES):
            watcher = Watcher(stop_at=stage)
            with pytest.raises(KeyboardInterrupt):
                run_pipeline(small_scene, output.name, quality="fast", monitor=watcher)
            assert watcher.reused_stages == STAGES[: max(index - 1, 0)]
            assert watcher.ran == STAGES[max(index - 1, 0) : index]
        last = Watcher()
        run_pipeline(small_scene, output.name, quality="fast", monitor=last)
        assert (last.reused_stages, last.ran) == (STAGES[:-1], STAGES[-1:])
        assert last.left, "the exports say how long they take"
        assert None not in last.left
    return output


@pytest.fixture
def own(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished pipeline's folder, whose files keep their times."""
    return shutil.copytree(finished, tmp_path / "own")


def test_everything_lands_in_one_folder(finished, small_scene):
    before = sorted(path for path in small_scene.rglob("*"))
    watcher = Watcher()
    results = run_pipeline(small_scene, finished, quality="fast", monitor=watcher)
    assert watcher.ran == []
    assert watcher.reused_stages == STAGES
    assert watcher.plan is not None
    assert watcher.plan.seconds == 0
    files = (results.scene_page, results.report, results.page, results.contact_sheet)
    assert all(path is not None and path.is_file() for path in files)
    assert (results.exports / "points.ply").is_file()
    assert any(results.renders.rglob("*.tiff"))
    assert results.run == finished / "fast"
    assert read_survey(results.run / SURVEY_FILE) == Survey()
    assert sorted(path for path in small_scene.rglob("*")) == before, "the scene is only read"


def test_the_results_lie_beside_the_photos_by_default(small_scene):
    folder = run_module.default_output(small_scene, PrepareOptions())
    assert folder == small_scene.parent / f"{small_scene.name}-mrgs"
    assert run_module.default_output(small_scene / "transforms.json", PrepareOptions()) == folder
    of_one = run_module.default_output(small_scene, PrepareOptions(camera="../FLIR E8"))
    assert of_one == small_scene.parent / f"{small_scene.name}-..-FLIR-E8-mrgs"


def test_a_result_that_is_gone_is_made_again_and_nothing_else(own, small_scene):
    (own / "fast" / "report.html").unlink()
    watcher = Watcher()
    run_pipeline(small_scene, own, quality="fast", monitor=watcher)
    assert watcher.ran == ["report"]


@pytest.mark.slow
def test_what_is_stated_or_marked_later_is_reported(own, small_scene):
    def run_again() -> list[str]:
        watcher = Watcher()
        run_pipeline(small_scene, own, quality="fast", monitor=watcher)
        return watcher.ran

    (own / "fast" / "survey.yaml").write_text("client: somebody\n", encoding="utf-8")
    assert run_again() == ["report", "page", "exports"]
    assert "somebody" in (own / "fast" / "report.html").read_text(encoding="utf-8")
    assert run_again() == []
    marks = open_marks(load_run(own / "fast"))
    marks.store.edit(lambda _: Marks(proposals=(SPOT,)))
    assert run_again() == []
    marks.accept("H1")
    assert run_again() == ["report", "page", "exports"]
    everything = Survey(crop_outlines=(((-99.0, -99.0), (99.0, -99.0), (0.0, 99.0)),))
    write_survey(own / "fast" / "survey.yaml", everything)
    assert run_again() == ["render", "report", "page", "exports"]
    (own / "fast" / "marks.json").write_text("[", encoding="utf-8")
    with pytest.warns(MrgsWarning, match="is damaged"):
        assert run_again() == ["report", "page", "exports"]


def test_another_quality_keeps_the_first_one(own, small_scene):
    watcher = Watcher(stop_at="score")
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(small_scene, own, quality="best", monitor=watcher)
    assert watcher.reused_stages == ["check"]
    assert watcher.ran == ["train"]
    assert (own / "fast" / "report.html").is_file()
    assert (own / "best" / "checkpoints").is_dir()


def test_a_changed_scene_is_trained_anew_and_the_old_model_is_kept(own, tmp_path):
    scene = write_scene(tmp_path / "scene", two_cameras=True)
    watcher = Watcher(stop_at="score")
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(scene, own, quality="fast", monitor=watcher)
    assert watcher.ran == ["check", "train"]
    assert (own / "fast-1" / "report.html").is_file()
    assert not (own / "fast" / "report.html").exists()


def exported_again(file: Path, content: bytes) -> None:
    """Another content of the same size, with the old time."""
    status = file.stat()
    assert len(content) == status.st_size
    file.write_bytes(content)
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.mark.slow
def test_a_photo_with_its_old_size_and_time_is_a_change(small_scene, tmp_path):
    scene, output = shutil.copytree(small_scene, tmp_path / "scene"), tmp_path / "results"

    def ran(stop_at: str) -> list[str]:
        watcher = Watcher(stop_at=stop_at)
        with pytest.raises(KeyboardInterrupt):
            run_pipeline(scene, output, quality="fast", monitor=watcher)
        return watcher.ran

    image = min((scene / "thermal").iterdir())
    original = image.read_bytes()
    image.write_bytes(original + bytes(100))  # what is behind its end is not read
    assert ran("score") == ["check", "train"]
    exported_again(image, original + bytes(100))
    assert ran("score") == [], "it holds the same"
    exported_again(image, original + b"1" * 100)
    assert ran("score") == ["check", "train"]


@pytest.mark.slow
def test_a_photo_exported_again_is_prepared(prepared, tmp_path):
    photos, options = photos_in(tmp_path / "photos"), PrepareOptions(thermal_fov_deg=57.0)
    for number in range(2):
        watcher = Watcher(stop_at="train")
        with pytest.raises(KeyboardInterrupt):
            run_pipeline(photos, quality="fast", options=options, monitor=watcher)
        assert watcher.ran == ["prepare"], number
        file = photos / "DJI_0004_T.tiff"
        exported_again(file, file.read_bytes()[:-1] + b"x")


def test_a_training_that_was_stopped_is_resumed(small_scene, tmp_path):
    class Stopping(Watcher):
        def stepped(self, statistics):
            return statistics.step == 1

    output = tmp_path / "results"
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(small_scene, output, quality="fast", monitor=Stopping())
    checkpoints = output / "fast" / "checkpoints"
    assert [path.name for path in checkpoints.iterdir()] == ["step_000001.safetensors"]
    steps = []

    class Counting(Watcher):
        def stepped(self, statistics):
            steps.append(statistics.step)

    with pytest.raises(KeyboardInterrupt):
        run_pipeline(small_scene, output, quality="fast", monitor=Counting(stop_at="score"))
    assert steps == [2]


def test_warnings_stop_it_unless_they_are_accepted(small_scene, tmp_path):
    refusing = Watcher(accept=False)
    with pytest.raises(SceneError, match=r"stopped at .*check") as error:
        run_pipeline(small_scene, tmp_path / "results", quality="fast", monitor=refusing)
    assert error.value.options == ("yes",)
    assert refusing.warnings
    accepting = Watcher(stop_at="train")
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(small_scene, tmp_path / "results", quality="fast", monitor=accepting)
    assert accepting.ran == ["check"], "it was not done"


def test_errors_stop_it_and_cannot_be_accepted(make_scene, tmp_path):
    folder = make_scene()
    image = folder / "images" / "frame_train_00003.png"
    image.write_bytes(image.read_bytes()[:-200])
    watcher = Watcher()
    with pytest.raises(SceneError, match=r"check\.html") as error:
        run_pipeline(folder, tmp_path / "results", quality="fast", monitor=watcher)
    assert error.value.options == (), "there is nothing to accept"
    assert (watcher.warnings, watcher.ran) == ((), [])


def photos_in(folder: Path) -> Path:
    """Five pairs."""
    folder.mkdir()
    for number in range(5):
        (folder / f"DJI_000{number}_V.JPG").write_bytes(photo("jpg", (32, 24)))
        (folder / f"DJI_000{number}_T.tiff").write_bytes(photo("celsius"))
    return folder


def replace_prepare(monkeypatch: pytest.MonkeyPatch, prepare: Callable[..., Preparation]) -> None:
    """Poses of real photos would take minutes."""
    monkeypatch.setattr(stages_module, "prepare", prepare)


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch) -> list[PrepareOptions]:
    """In place of ``prepare``: writes a small scene; needs the thermal camera's field of view."""
    calls: list[PrepareOptions] = []

    def prepare(photos, scene, options, progress, report, *, trains) -> Preparation:
        assert trains, "the page does not lead away from the pipeline"
        calls.append(options)
        progress("poses: features", 1, 2)
        if options.thermal_fov_deg is None:
            raise SceneError("cannot be placed", options=("thermal_fov_deg", "thermal_camera"))
        write_scene(scene)
        (scene / "prepare.html").write_text("page")
        stage = StageReport("pairs", ("5 pairs.",), ("The clocks differ.",))
        report(stage)
        return Preparation(scene, scene / "prepare.html", (stage,))

    replace_prepare(monkeypatch, prepare)
    return calls


def test_what_photos_do_not_say_is_asked_once(prepared, tmp_path):
    asked = []

    class Answering(Watcher):
        def answer(self, error: MrgsError, options: PrepareOptions) -> PrepareOptions | None:
            asked.append(error.options)
            return PrepareOptions(thermal_fov_deg=57.0)

    photos, watcher = photos_in(tmp_path / "photos"), Answering(stop_at="train")
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_pipeline(photos, quality="fast", monitor=watcher)
    assert asked == [("thermal_fov_deg", "thermal_camera")]
    assert len(prepared) == 2
    (warning,) = watcher.warnings
    assert warning.endswith("The clocks differ.")
    assert watcher.reused_stages == ["prepare"]
    assert (tmp_path / "photos-mrgs" / "photos" / "transforms.json").is_file()
    with pytest.raises(SceneError, match="cannot be placed"):
        run_pipeline(photos, tmp_path / "other", quality="fast", monitor=Watcher())


def grey_photos_in(folder: Path) -> Path:
    """Five pairs whose thermal photos are shades of grey."""
    for name, kind in (("rgb", "jpg"), ("thermal", "png")):
        (folder / name).mkdir(parents=True)
        for number in range(5):
            (folder / name / f"{number}.{kind}").write_bytes(photo(kind, (32, 24)))
    return folder


def test_photos_without_celsius_stop_it_before_poses_are_computed(prepared, tmp_path):
    photos = grey_photos_in(tmp_path / "photos")
    with pytest.raises(SceneError, match="no °C") as error:
        run_pipeline(photos, quality="fast")
    assert error.value.options == ("bounds_c", "yes")
    assert "black and white" in str(error.value)
    assert "radiometric files" in str(error.value)
    assert prepared == []


def test_photos_without_celsius_can_be_accepted(prepared, tmp_path):
    class Relative(Watcher):
        def accepts_relative(self, reason: MrgsError) -> bool:
            asked.append(reason.options)
            return True

    asked: list[tuple[str, ...]] = []
    photos, options = grey_photos_in(tmp_path / "photos"), PrepareOptions(thermal_fov_deg=57.0)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_pipeline(photos, quality="fast", options=options, monitor=Relative("train"))
    assert asked == [("bounds_c",)], "not again once the photos are prepared"
    assert len(prepared) == 1


def test_what_was_accepted_before_poses_is_not_asked_after_them(tmp_path):
    asked: list[Sequence[str]] = []

    class Refusing(Watcher):
        def accepts(self, warnings: Sequence[str], page: Path) -> bool:
            asked.append(warnings)
            return False

    photos = grey_photos_in(tmp_path / "photos")
    options, monitor = PrepareOptions(), Refusing()
    intake = take_in(photos, options)
    job = stages_module.Job(intake, QUALITIES["fast"], options, tmp_path, "cpu", monitor)
    job.accepted = intake.without_celsius
    job._require_accepted([f"images: {job.accepted} (5 photos)"], tmp_path)
    assert asked == []
    with pytest.raises(SceneError, match="at 2 warnings"):
        job._require_accepted([f"images: {job.accepted}", "pairs: blurred"], tmp_path)
    assert len(asked[0]) == 2


def test_a_warning_of_two_stages_counts_once_as_on_the_page(tmp_path, monkeypatch):
    def prepare(photos, scene, options, progress, report, *, trains) -> Preparation:
        write_scene(scene)
        (scene / "prepare.html").write_text("page")
        stages = [StageReport(title, ("5.",), ("Blurred.",)) for title in ("images", "page")]
        return Preparation(scene, scene / "prepare.html", tuple(stages))

    replace_prepare(monkeypatch, prepare)
    watcher = Watcher(accept=False)
    with pytest.raises(SceneError, match="at 1 warning"):
        run_pipeline(photos_in(tmp_path / "photos"), quality="fast", monitor=watcher)
    assert watcher.warnings == ["images: Blurred."]


def test_photos_that_are_prepared_already_are_expected_to_take_no_time(prepared, tmp_path):
    photos, options = photos_in(tmp_path / "photos"), PrepareOptions(thermal_fov_deg=57.0)

    def expected(new: PrepareOptions) -> float:
        """Beside the training: how fast the computer is changes with what else runs on it."""
        watcher = Watcher(accept=False)
        with pytest.raises(SceneError, match="at 1 warning"):
            run_pipeline(photos, quality="fast", options=new, monitor=watcher)
        assert watcher.plan is not None
        first, *others = watcher.plan.stages
        assert not first.is_done
        (training,) = (stage for stage in others if stage.name == "train")
        return first.seconds / training.seconds

    first, again = expected(options), expected(options)
    assert again < 0.1 * first
    assert expected(PrepareOptions(thermal_fov_deg=50.0)) > 0.5 * first, "another thermal camera"


def test_a_new_photo_is_prepared(prepared, tmp_path):
    photos, options = photos_in(tmp_path / "photos"), PrepareOptions(thermal_fov_deg=57.0)
    for number, ran in ((0, ["prepare"]), (1, []), (2, ["prepare"])):
        if number == 2:
            (photos / "notes.txt").write_text("new")
        watcher = Watcher(stop_at="train")
        with pytest.raises(KeyboardInterrupt):
            run_pipeline(photos, quality="fast", options=options, monitor=watcher)
        assert watcher.ran == ran


def test_missing_extras_are_noticed_before_the_first_stage(tmp_path, monkeypatch):
    monkeypatch.setattr("mrgs.prepare.sfm.reconstruct.find_spec", lambda name: None)
    photos = photos_in(tmp_path / "photos")
    with pytest.raises(ConfigError, match=r"\"mrgs\[sfm\]\""):
        run_pipeline(photos, quality="fast")
    assert not (tmp_path / "photos-mrgs").exists()


def test_a_full_disk_is_noticed_before_the_first_stage(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("mrgs.pipeline.run.free_disk", lambda folder: 1_000_000)
    with pytest.raises(RunError, match=r"0\.1 GB, .*0\.0 GB"):
        run_pipeline(small_scene, tmp_path / "results", quality="fast")
    assert not (tmp_path / "results").exists()


def test_little_memory_is_said(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("mrgs.pipeline.run.free_memory", lambda: 10_000_000)
    watcher = Watcher(stop_at="check")
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(small_scene, tmp_path / "results", quality="fast", monitor=watcher)
    assert watcher.plan is not None
    assert "GB of memory" in watcher.plan.notes[-1]


def test_folders_that_cannot_hold_the_results_are_refused(small_scene, finished, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for output, message in (
        (tmp_path, "holds something else"),
        (small_scene, "folder of the photos"),
        (small_scene / "results", "folder of the photos"),
    ):
        with pytest.raises(RunError, match=message) as error:
            run_pipeline(small_scene, output, quality="fast")
        assert error.value.options == ("output",)
    with pytest.raises(RunError, match="earlier run"):
        run_pipeline(finished, tmp_path / "new", quality="fast")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_folder_in_use_is_left_alone(own, small_scene):
    with FileLock(own / ".lock"), pytest.raises(RunError, match="in use"):
        run_pipeline(small_scene, own, quality="fast")


def test_a_flat_field_is_part_of_the_settings(tmp_path):
    config = replace(QUALITIES["fast"], flat_field=tmp_path, flat_field_unit="kelvin*100").config()
    assert config.image_model.flat_field == str(tmp_path)
    without = replace(config.image_model, flat_field=None, flat_field_unit=None)
    assert without == QUALITIES["fast"].config().image_model
    assert config.image_model.flat_field_unit == "kelvin*100"


def test_other_frames_of_the_flat_field_are_other_settings(small_scene, tmp_path):
    frame = tmp_path / "flat" / "frame.tiff"
    frame.parent.mkdir()
    quality = replace(QUALITIES["fast"], flat_field=frame.parent)
    made_from = []
    for content in (b"one", b"another"):
        frame.write_bytes(content)
        intake = take_in(small_scene, PrepareOptions(), lambda *step: None)
        job = stages_module.Job(intake, quality, PrepareOptions(), tmp_path, "cpu", Monitor())
        made_from.append(job.stages[1].made_from())
    assert made_from[0] != made_from[1]


def test_a_flat_field_that_is_no_folder_is_refused_before_anything_is_written(
    small_scene, tmp_path
):
    with pytest.raises(ConfigError, match="uniform target") as caught:
        run_pipeline(small_scene, tmp_path / "out", flat_field=tmp_path / "missing")
    assert caught.value.options == ("flat_field",)
    assert not (tmp_path / "out").exists()


def test_an_unknown_quality_is_named(small_scene, tmp_path):
    with pytest.raises(ConfigError, match=r"'good'; .*fast, default"):
        run_pipeline(small_scene, tmp_path / "results", quality="good")


def test_the_ledger_knows_every_stage(finished):
    stages = json.loads((finished / LEDGER).read_text())
    assert [*stages] == ["prepare", *(f"fast/{name}" for name in STAGES[1:])]


@pytest.mark.parametrize("name", ["poses", "control", "thermal_camera"])
def test_a_given_file_that_has_changed_is_noticed(tmp_path, name):
    given = tmp_path / "given.json"
    given.write_text("{}")
    options = PrepareOptions(**{name: given})
    intake = take_in(photos_in(tmp_path / "photos"), options)
    job = stages_module.Job(intake, QUALITIES["fast"], options, tmp_path, "cpu", Monitor())
    (first, *_) = job.stages
    before = first.made_from()
    assert first.made_from() == before
    given.write_text("{ }")
    assert first.made_from() != before
