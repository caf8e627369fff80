"""``mrgs prepare`` as its user sees it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

from mrgs.app.cli import main
from mrgs.app.commands import PhotoOptions
from mrgs.app.progress import PrepareProgress
from mrgs.app.terminal import flag_of
from mrgs.check import Problem
from mrgs.data.radiometric import Overrides
from mrgs.errors import SceneError
from mrgs.prepare import KnownDistance, Preparation, PrepareOptions, Skipped, StageReport
from mrgs.prepare.page.check import SceneCheck


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable], None]:
    """Puts a function in the place of ``prepare``."""
    return lambda function: monkeypatch.setattr("mrgs.prepare.run.prepare", function)


@pytest.fixture
def asked(stand_in) -> list:
    """What ``prepare`` is called with; it reports two stages, and leaves files out."""
    calls: list = []

    def prepare(photos, scene, options, progress, report) -> Preparation:
        calls.append((photos, scene, options))
        progress("pairs: reading", 1, 4)
        stages = (
            StageReport("pairs", ("4 pairs. By names.", "25 files skipped."), (), 0.25),
            StageReport("thermal camera", ("57.0° wide.",), ("The camera moved.",), 0.0, True),
        )
        for stage in stages:
            report(stage)
        skipped = tuple(Skipped(f"{number}.txt", "is not a photo") for number in range(25))
        return Preparation(scene, scene / "prepare.html", stages, skipped)

    stand_in(prepare)
    return calls


def run(*arguments: object) -> int:
    return main(["prepare", *(str(argument) for argument in arguments)])


def test_stages_are_said_and_what_to_do_next(asked, capsys):
    assert run("photos", "my scene") == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "pairs:           4 pairs. By names. (0.2 s)",
        "                 25 files skipped.",
        "thermal camera:  57.0° wide. (as before)",
        "scene: my scene",
        "open:  my scene/prepare.html",
        "next:  mrgs train 'my scene'",
    ]
    moved, *skipped, more = printed.err.splitlines()
    assert "The camera moved." in moved
    assert [f" {number}.txt: " in line for number, line in enumerate(skipped)] == 20 * [True]
    assert " 5 more" in more
    assert "my scene/prepare.html" in more
    assert asked == [(Path("photos"), Path("my scene"), PrepareOptions())]


def test_every_option_arrives(asked):
    line = """--pairs names --tolerance 3 --poses poses --emissivity 0.9 --reflected -5
    --distance 10 --atmospheric 4
    --humidity 0.4 --window 21 --window-transmission 0.8 --unit kelvin*100 --thermal-fov 57
    --thermal-camera camera.json
    --known-distance a:1,2 a:3,4 0.5 --eval-every 5"""
    assert run("photos", "scene", *line.split()) == 0
    assert asked[0][2] == PrepareOptions(
        overrides=Overrides(0.9, 10.0, -5.0, 4.0, 0.4, 21.0, 0.8, "kelvin*100"),
        pairs="names",
        tolerance_s=3.0,
        poses=Path("poses"),
        thermal_fov_deg=57.0,
        thermal_camera=Path("camera.json"),
        known_distance=KnownDistance("a", (1.0, 2.0), (3.0, 4.0), 0.5),
        eval_every=5,
    )
    assert (
        run(
            "photos",
            "scene",
            "--pair-table",
            "pairs.csv",
            "--bounds",
            -10,
            40,
            "--target",
            "7x6",
            0.05,
        )
        == 0
    )
    options = asked[1][2]
    assert (options.pair_table, options.overrides.bounds_c) == (Path("pairs.csv"), (-10.0, 40.0))
    assert (options.target.inner, options.target.square_m) == ((7, 6), 0.05)
    assert run("photos", "scene", "--one-camera") == 0
    assert asked[2][2].one_camera


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("photos", "scene", "--emissivity", 2), r"emissivity = 2 .*0\.01 and 1"),
        (("photos", "scene", "--target", "7", 0.05), "target .7.: .*\\(--target\\)"),
        (
            ("photos", "scene", "--eval-every", 1),
            "2 or more",
        ),
    ],
)
def test_a_bad_option_is_one_line(arguments, message, asked, capsys):
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.match(f"mrgs: error: .*{message}", error), error
    assert asked == []


@pytest.mark.parametrize("kind", [PrepareOptions, Overrides])
def test_every_option_of_the_python_api_has_its_flag(kind):
    flags = {f"--{field.name.replace('_', '-')}" for field in fields(PhotoOptions)}
    names = {field.name for field in fields(kind)} - {"overrides"}
    assert {flag_of(name) for name in names} <= flags


def test_both_folders_are_needed(asked):
    with pytest.raises(SystemExit) as end:
        run("photos")
    assert end.value.code == 2
    assert asked == []


def test_a_missing_folder_is_one_line_and_nothing_is_made(tmp_path, capsys):
    assert run(tmp_path / "nowhere", tmp_path / "scene") == 2
    assert re.fullmatch(
        r"mrgs: error: .*nowhere: not a folder; give the .* folder.*\n", capsys.readouterr().err
    )
    assert list(tmp_path.iterdir()) == []


def test_what_was_found_before_an_error_is_said(stand_in, capsys):
    def prepare(photos, scene, options, progress, report):
        report(StageReport("pairs", ("4 pairs.",), ("The clocks differ.",), 0.1))
        raise SceneError("fewer than 3 views have a pose")

    stand_in(prepare)
    assert run("photos", "scene") == 2
    printed = capsys.readouterr()
    assert printed.out.split() == ["pairs:", "4", "pairs.", "(0.1", "s)"]
    note, error = printed.err.splitlines()
    assert note.endswith("pairs: The clocks differ.")
    assert error.startswith("mrgs: error: fewer than")


def test_ctrl_c_says_that_the_same_command_goes_on(stand_in, capsys):
    def prepare(*arguments):
        raise KeyboardInterrupt

    stand_in(prepare)
    assert run("photos", "scene") == 130
    printed = capsys.readouterr()
    assert "same command" in printed.out
    assert printed.err == "mrgs: stopped\n"


def test_on_a_terminal_one_line_follows_the_step(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with PrepareProgress() as progress:
        progress.step("poses: matching", 3, 7)
        progress.step("poses [mapping]", 0, 0)
        progress.stage(StageReport("poses", ("4 of 4.",), (), 61.0))
    out = capsys.readouterr().out
    before, _, after = out.partition("poses [mapping] ")
    assert re.search(r"poses: matching 3/7 .*0:00:00", before)
    assert "\033[2K" in after, "the bar is erased before the stage is printed"
    assert after.endswith("poses:           4 of 4. (61.0 s)\n")


@pytest.mark.parametrize(("severity", "code"), [("warning", 0), ("error", 1)])
def test_check_lists_problems_and_its_exit_code_is_1_on_errors(severity, code, monkeypatch, capsys):
    def check_scene(scene, progress) -> SceneCheck:
        progress("looking at images", 1, 8)
        problems = (Problem(severity, "Points lie behind.", "Turn the poses."),)
        return SceneCheck(problems, ("8 views.",), scene / "check.html")

    monkeypatch.setattr("mrgs.prepare.page.check.check_scene", check_scene)
    assert main(["check", "scene"]) == code
    assert capsys.readouterr().out.splitlines() == [
        "8 views.",
        f"{severity}: Points lie behind. Turn the poses.",
        "open: scene/check.html",
    ]
