"""``mrgs run`` and ``mrgs demo`` as their user sees them."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from mrgs.app import cli, pipeline
from mrgs.app.cli import main
from mrgs.app.commands import COMMANDS
from mrgs.app.pipeline import PipelineTerminal, rough
from mrgs.errors import SceneError
from mrgs.pipeline.plan import QUALITIES, Quality
from mrgs.prepare import PrepareOptions
from tests.helpers.photos import photo


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quality that takes seconds."""
    monkeypatch.setitem(QUALITIES, "fast", Quality("fast", "fast", 2, 100, 640))


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_the_time_counts_other_programs(tmp_path, monkeypatch):
    alone, busy = r"about 10 minutes \(", "about 10 minutes, about 25 minutes if other programs"
    for factor, expected in ((1.0, alone), (2.5, busy)):
        plan = SimpleNamespace(
            seconds=600.0, quality=QUALITIES["fast"], stages=(), cores=2, free_memory=None,
            memory=1, disk=1, output=tmp_path, device="cpu",
            intake=SimpleNamespace(kind="scene", source="s", summary="", facts=()),
        )  # fmt: skip
        monkeypatch.setattr(pipeline, "waiting_factor", lambda factor=factor: factor)
        assert re.match(expected, pipeline._plan_lines(plan)["time"])


class Terminal(io.StringIO):
    """A terminal whose user types one answer."""

    def isatty(self) -> bool:
        return True


def typed(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(answer + "\n"))


def test_it_says_what_was_understood_how_far_it_is_and_what_to_open(small_scene, tmp_path, capsys):
    output = tmp_path / "results"
    arguments = ("run", small_scene, "--quality", "fast", "--output", output)
    assert run(*arguments, "--yes") == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0].endswith("8 views, RGB 40×30 px, thermal 40×30 px, temperatures in °C")
    assert re.match(r"computer: \d+ cores?.* GB disk free", lines[1])
    assert re.match(r"time:     about .* \(check 0:\d\d, train \d:\d\d, .*exports \d", lines[4])
    stages = [line for line in lines if re.match(r"stage \d of 7: \w+ \(about ", line)]
    names = [line.split()[4] for line in stages]
    assert names == ["check", "train", "score", "render", "report", "page", "exports"]
    assert re.search(r"^exports: mesh \| 0:\d\d left$", printed.out, re.MULTILINE)
    assert re.search(
        r"^report: measurements and pictures \| 0:\d\d left$", printed.out, re.MULTILINE
    )
    opened = lines.index("open:")
    assert lines[opened + 1] == f"  {output / 'fast' / 'report.html'}"
    assert lines[-1].endswith(f"mrgs view {output / 'fast'}")
    assert all(Path(line.strip()).exists() for line in lines[opened + 1 : -1 : 2])
    assert "mrgs: warning: " in printed.err

    assert run(*arguments) == 0, "what was accepted is not asked again"
    again = capsys.readouterr()
    assert again.out.count("(done before)") == 7
    assert again.out.splitlines()[-1] == lines[-1]


def test_warnings_stop_it_where_nobody_can_be_asked(small_scene, tmp_path, capsys):
    assert run("run", small_scene, "--quality", "fast", "--output", tmp_path / "results") == 2
    error = capsys.readouterr().err.splitlines()
    assert error[-1].startswith("mrgs: error: stopped at ")
    assert error[-1].endswith("(--yes)")
    assert error[0].startswith("mrgs: warning: ")


@pytest.mark.parametrize(
    ("answer", "goes_on"), [("y", True), ("Yes", True), ("n", False), ("", False)]
)
def test_at_a_terminal_it_asks(answer, goes_on, monkeypatch, capsys):
    typed(monkeypatch, answer)
    assert PipelineTerminal(yes=False).accepts(["pairs: blurred"], Path("page.html")) == goes_on
    printed = capsys.readouterr()
    assert printed.err.endswith("pairs: blurred\n")
    assert "page.html" in printed.out
    assert printed.out.endswith("[y/N] ")


@pytest.mark.parametrize(("answer", "goes_on"), [("y", True), ("", False)])
def test_photos_without_celsius_are_asked_about(answer, goes_on, monkeypatch, capsys):
    typed(monkeypatch, answer)
    reason = SceneError("no °C", options=("bounds_c",))
    assert PipelineTerminal(yes=False).accepts_relative(reason) == goes_on
    printed = capsys.readouterr()
    assert printed.err.endswith("no °C (--bounds)\n")
    assert "relative" in printed.out
    assert printed.out.endswith("[y/N] ")
    assert PipelineTerminal(yes=True).accepts_relative(reason)


def test_photos_without_celsius_stop_it_at_once_and_name_the_option(tmp_path, capsys):
    for name, kind in (("rgb", "jpg"), ("thermal", "png")):
        (tmp_path / "photos" / name).mkdir(parents=True)
        for number in range(3):
            file = tmp_path / "photos" / name / f"{number}.{kind}"
            file.write_bytes(photo(kind, (32, 24)))
    assert run("run", tmp_path / "photos", "--quality", "fast") == 2
    printed = capsys.readouterr()
    assert "stage 1" not in printed.out
    error = printed.err.splitlines()[-1]
    assert error.startswith("mrgs: error: ")
    assert "no °C" in error
    assert "grey" in error
    assert error.endswith("(--bounds, --yes)")


@pytest.mark.parametrize(
    ("answer", "degrees"), [("57", 57.0), ("42.5", 42.5), ("", None), ("wide", None)]
)
def test_a_field_of_view_is_asked_for(answer, degrees, monkeypatch, capsys):
    typed(monkeypatch, answer)
    error = SceneError("cannot be placed", options=("thermal_fov_deg", "target"))
    options = PipelineTerminal(yes=True).answer(error, PrepareOptions())
    assert (None if options is None else options.thermal_fov_deg) == degrees
    assert "cannot be placed" in capsys.readouterr().out


def test_a_unit_is_asked_for_and_only_once(monkeypatch):
    error = SceneError("could be °C or K", options=("unit",))
    typed(monkeypatch, "kelvin*100")
    options = PipelineTerminal(yes=False).answer(error, PrepareOptions())
    assert options is not None
    assert options.overrides.unit == "kelvin*100"
    typed(monkeypatch, "celsius")
    assert PipelineTerminal(yes=False).answer(error, options) is None


def test_what_nobody_can_know_is_not_asked(monkeypatch):
    typed(monkeypatch, "57")
    error = SceneError("no pairs", options=("pair_table",))
    assert PipelineTerminal(yes=False).answer(error, PrepareOptions()) is None


def test_an_interrupted_run_says_how_to_go_on(small_scene, monkeypatch, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "run_pipeline", interrupted)
    assert run("run", small_scene, "--quality", "fast") == 130
    assert "resume" in capsys.readouterr().err


MISUSE = {
    "wrong path": ((), "photos: not a folder"),
    "empty folder": ({}, "holds no photos"),
    "other files": ({"a.txt": b"text"}, "none of its 1 files"),
    "one pair": (
        {"1_V.JPG": photo("jpg", (32, 24)), "1_T.tiff": photo("celsius")},
        "1 pair .*3",
    ),
    "no thermal photos": (
        {f"{number}.jpg": photo("jpg") for number in range(4)},
        r"thermal.*\(--pair-table\)",
    ),
}


@pytest.mark.parametrize(("files", "message"), MISUSE.values(), ids=MISUSE)
def test_misuse_is_one_line_and_leaves_nothing(files, message, tmp_path, capsys):
    photos = tmp_path / "photos"
    if files != ():
        photos.mkdir()
        for name, content in files.items():
            (photos / name).write_bytes(content)
    assert run("run", photos) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(f"mrgs: error: .*{message}.*\n", error), error
    assert not (tmp_path / "photos-mrgs").exists()


def test_the_demo_is_the_same_with_the_bundled_scene(small_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_bundled_scene", lambda: small_scene)
    assert run("demo", "--output", tmp_path / "demo") == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.endswith(f"mrgs view {tmp_path}/demo/fast")


def test_it_is_the_first_command():
    assert next(iter(COMMANDS)) == "run"


def test_times_are_rounded():
    times = {3: "5 seconds", 42: "40 seconds", 100: "2 minutes", 3000: "50 minutes"}
    assert all(rough(seconds) == f"about {text}" for seconds, text in times.items())
    assert rough(7000) == "about 1.9 hours"


def test_photos_of_several_cameras_become_a_model_each(tmp_path, monkeypatch, capsys):
    photos, begun = tmp_path / "photos", []
    photos.mkdir()
    for number in range(3):
        for model in ("M3T", "FLIR E8"):
            content = photo("celsius", model=model)
            (photos / f"{model}{number}_T.tiff").write_bytes(content)
            (photos / f"{model}{number}_W.jpg").write_bytes(photo("jpg", model=model))

    def prepare(photos, scene, options, *_, **__):
        begun.append((scene, options.camera))
        raise SceneError("no poses")

    monkeypatch.setattr("mrgs.pipeline.stages.prepare", prepare)
    assert run("run", photos, "--quality", "fast") == 2
    printed = capsys.readouterr().err
    assert all(text in printed for text in ("FLIR E8, M3T", "FLIR E8: no poses", "M3T: no poses"))
    assert begun == [
        (tmp_path / "photos-FLIR-E8-mrgs" / "photos-FLIR-E8", "FLIR E8"),
        (tmp_path / "photos-M3T-mrgs" / "photos-M3T", "M3T"),
    ]
    begun.clear()
    results = tmp_path / "results"
    for arguments in (
        ("--camera", "M3T", "--output", results / "photos-M3T"),
        ("--output", results),
    ):
        run("run", photos, "--quality", "fast", *arguments)
    scene = results / "photos-M3T" / "photos-M3T"
    assert [place for place, camera in begun if camera == "M3T"] == [scene, scene]
    begun.clear()
    for of_one in (
        ("--thermal-fov", "57"),
        ("--poses", tmp_path),
        ("--known-distance", "M3T0:1,2", "M3T0:3,4", "1.5"),
    ):
        assert run("run", photos, "--quality", "fast", *of_one) == 2
    assert begun == [], "what is known of one camera is not true of the other"
    capsys.readouterr()
    assert run("prepare", photos, tmp_path / "scene") == 2
    assert "(--camera)" in capsys.readouterr().err


def test_cameras_whose_names_differ_in_punctuation_have_folders_of_their_own(tmp_path):
    each = [PrepareOptions(camera=name) for name in ("M3 T", "M3-T", "m3/t", "E8")]
    source, output = tmp_path / "photos", tmp_path / "out"
    names = ["photos-M3-T", "photos-M3-T-2", "photos-m3-t-3", "photos-E8"]
    assert [*pipeline._folders(source, output, each)] == [output / name for name in names]
    assert [*pipeline._folders(source, None, each)] == [
        None, tmp_path / f"{names[1]}-mrgs", tmp_path / f"{names[2]}-mrgs", None,
    ]  # fmt: skip


def test_a_camera_of_photos_is_refused_with_a_scene_before_anything_is_written(
    make_scene, tmp_path, capsys
):
    scene = make_scene()
    before = {*tmp_path.rglob("*")}
    assert run("run", scene, "--camera", "M3T") == 2
    assert "(--camera)" in capsys.readouterr().err
    assert {*tmp_path.rglob("*")} == before
