from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

from mrgs.errors import RunError, SceneError
from mrgs.prepare.stages import Stage, Stages, Told, digest, only_one, stamps


class Counted:
    """A stage that counts how often it is done."""

    def __init__(self, *depends: object, result: str = "found", file: Path | None = None) -> None:
        self.times = 0
        self.stage = Stage(
            "first stage", str, depends, self.make, self.tell, lambda _: [file] if file else []
        )
        self.result = result

    def make(self, progress) -> str:
        self.times += 1
        progress("looking", 1, 2)
        return self.result

    @staticmethod
    def tell(result: str) -> Told:
        return Told((f"It is {result}.",), ("Mind the step.",))


def test_a_stage_is_done_once_and_said_twice(tmp_path):
    counted, steps, reports = Counted("photos"), [], []
    for _ in range(2):
        stages = Stages(tmp_path, lambda *step: steps.append(step), reports.append)
        assert stages.run(counted.stage) == "found"
        assert stages.reports == reports[-1:]
    assert counted.times == 1
    assert steps == [("first stage", 0, 0), ("first stage: looking", 1, 2)]
    assert [report.reused for report in reports] == [False, True]
    assert reports[0].seconds > 0 == reports[1].seconds
    assert {(report.title, report.lines, report.warnings) for report in reports} == {
        ("first stage", ("It is found.",), ("Mind the step.",))
    }


@pytest.mark.parametrize("change", ["dependence", "damage", "missing file"])
def test_a_stage_is_done_again_when_something_changed(change, tmp_path):
    file = tmp_path / "image.png"
    file.touch()
    counted = Counted("photos", file=file)
    Stages(tmp_path, None, None).run(counted.stage)
    stage = counted.stage
    if change == "dependence":
        stage = replace(stage, depends=("other photos",))
    elif change == "damage":
        (tmp_path / "first_stage.safetensors").write_bytes(b"torn")
    else:
        file.unlink()
    Stages(tmp_path, None, None).run(stage)
    assert counted.times == 2


def test_a_stage_that_was_cut_off_is_done_again(tmp_path):
    counted = Counted()

    def cut_off(progress) -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stages(tmp_path, None, None).run(replace(counted.stage, make=cut_off))
    assert list(tmp_path.iterdir()) == []
    assert Stages(tmp_path, None, None).run(counted.stage) == "found"


def test_a_folder_in_use_is_left_alone(tmp_path):
    folder = tmp_path / "scene" / "prepare"
    folder.mkdir(parents=True)
    message = "scene is being prepared by another run: wait for it, or choose another folder"
    with FileLock(folder / ".lock"), pytest.raises(RunError, match=message), only_one(folder):
        pass
    with only_one(folder):
        assert folder.is_dir()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "scene").write_text("mine")
    with (
        pytest.raises(RunError, match=r"scene/prepare cannot be written \(.*\): free the place"),
        only_one(tmp_path / "scene" / "prepare"),
    ):
        pass


def test_stamps_tell_of_every_change(tmp_path):
    (tmp_path / "b" / "c").mkdir(parents=True)
    for name in ("z.jpg", "b/y.jpg", "b/c/x.jpg"):
        (tmp_path / name).write_text(name)
    before = stamps(tmp_path)
    assert [name for name, *_ in before] == ["b/c/x.jpg", "b/y.jpg", "z.jpg"]
    assert stamps(tmp_path) == before
    os.utime(tmp_path / "b" / "y.jpg", ns=(1, 2))
    assert [a == b for a, b in zip(stamps(tmp_path), before, strict=True)] == [True, False, True]
    (tmp_path / "z.jpg").unlink()
    assert len(stamps(tmp_path)) == 2


def test_stamps_leave_hidden_files_out_and_follow_links(tmp_path):
    photo = tmp_path / "elsewhere.jpg"
    photo.write_text("1")
    (tmp_path / "photos" / ".Trashes").mkdir(parents=True)
    (tmp_path / "photos" / ".Trashes" / "a.jpg").write_text("old")
    (tmp_path / "photos" / "a.jpg").symlink_to(photo)
    (tmp_path / "photos" / "gone.jpg").symlink_to(tmp_path / "nowhere")
    before = stamps(tmp_path / "photos")
    assert [name for name, *_ in before] == ["a.jpg", "gone.jpg"]
    photo.write_text("12")
    assert [a == b for a, b in zip(stamps(tmp_path / "photos"), before, strict=True)] == [
        False,
        True,
    ]


def test_a_folder_that_cannot_be_listed_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"nowhere: cannot be read \(No such file"):
        stamps(tmp_path / "nowhere")


def test_digests_are_of_contents(tmp_path):
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (digest(tmp_path / name) for name in "abc")
    assert a == b != c
    assert digest(tmp_path / "missing") == ""
