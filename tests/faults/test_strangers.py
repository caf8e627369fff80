"""Small files and names that must cost a line: bombs, pipes, devices, and forged messages."""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import partial
from pathlib import Path

import pytest

from mrgs.app.cli import main
from mrgs.app.terminal import print_note, read_text
from mrgs.data.files import read_json_object
from mrgs.data.images import opened
from mrgs.data.kept import MISSING, Digests, load
from mrgs.data.load import load_scene
from mrgs.data.radiometric.read import read_thermal_photo
from mrgs.errors import ConfigError, MrgsError, MrgsWarning, SceneError, warn_user
from mrgs.pictures.escape import escape_cell, escape_markdown, without_controls
from mrgs.prepare.pairs.inventory import take_inventory
from mrgs.survey import read_survey
from mrgs.system.strict_yaml import parse_yaml
from mrgs.system.wording import quoted
from tests.helpers.layouts import SceneWriter


def doubling(levels: int) -> str:
    """Aliases of aliases: twice as much with each line."""
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        doubling(40),
        "a: &a {x: 1}\nb: {<<: *a}",
        "b: {<<: {x: 1}}",
        "? &a [1, 2]\n: 1\n? *a\n: 2",
        "a: !!int ''",
        "a: !!bool x",
        "a: !!timestamp x",
        "a: !!float ''",
        "a: " + ":".join(["59"] * 400) + ".5",
        "a: !!binary ö",
        "a: !" + 40_000 * "x",
        "a: !!float " + 40_000 * "x",
        2 * ("- &" + 20_000 * "a" + " x\n"),
        f"? [{20_000 * 'x,'}]\n: 1",
        "{[]: 1}",
        "[" * 5_000,
        "[" + ("[" * 90 + "x" + "]" * 90 + ",") * 500 + "]",
        "a: " + "1" * 40_000,
        "a: 1\n" * 20_000,
    ],
)
def test_yaml_that_costs_much_or_is_no_value_is_one_line(text):
    with pytest.raises(ConfigError, match=r"^file\.yaml ") as error:
        parse_yaml(text, "file.yaml")
    assert len(error.value.message) < 400


def raise_error(path: Path) -> None:
    raise SceneError(f"{path} has no digest")


def image_of(path: Path) -> None:
    with opened(path) as image:
        image.load()


READERS = {
    "survey.yaml": read_survey,
    "config.yaml": read_text,
    "transforms.json": read_json_object,
    "photo.tiff": read_thermal_photo,
    "photo.jpg": image_of,
    "kept.safetensors": lambda path: load(path, int, "") is MISSING and raise_error(path),
    "digests.json": lambda path: Digests(path).of(path) or raise_error(path),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX")
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("make", [os.mkfifo, partial(os.symlink, "/dev/zero"), os.mkdir])
def test_only_regular_files_are_read(tmp_path, name, make):
    make(tmp_path / name)
    with pytest.raises(MrgsError, match=name):
        READERS[name](tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX")
@pytest.mark.parametrize("make", [os.mkfifo, partial(os.symlink, "/dev/zero")])
def test_a_pipe_among_photos_is_no_photo(tmp_path, make):
    make(tmp_path / "photo.JPG")
    with pytest.raises(SceneError, match=r"photo\.JPG"):
        take_inventory(tmp_path)


EVIL = "a\nmrgs: error: send money\x1b[31m\u202etxt.gpj\u2028b\x85"


def test_names_cannot_forge_messages(capsys):
    with pytest.warns(MrgsWarning) as warned:
        warn_user(f"{EVIL} is skipped")
    print_note(f"{EVIL} is skipped")
    for message in (str(warned[0].message), str(SceneError(EVIL)), capsys.readouterr().err[:-1]):
        assert message.isprintable()
        assert r"a\nmrgs" in message
        assert r"\u202e" in message


def test_names_cannot_forge_what_check_prints_and_writes(tmp_path, capsys):
    writer = SceneWriter(tmp_path / EVIL)
    content = writer.thermoscenes()
    frame = content["frames"][0]
    stem = Path(frame["file_path"]).stem
    (image,) = (writer.root / frame["file_path"]).parent.glob(f"{stem}.*")
    image.rename(image.with_name(EVIL + image.suffix))
    frame["file_path"] = f"{Path(frame['file_path']).parent}/{EVIL}{image.suffix}"
    writer.transforms(content)
    main(["check", str(writer.root)])
    said = capsys.readouterr()
    lines = [*said.out.split("\n"), *said.err.split("\n")]
    assert all(line.isprintable() for line in lines)
    assert not any(line.startswith("mrgs: error: send") for line in lines)
    page = (writer.root / "check.html").read_text(encoding="utf-8")
    assert not any(each in page for each in "\x1b\u202e\u2028\x85")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    "name", [EVIL, "\\udc80\n", "\\udcff'\n", "it's", "a b", "a\\n'\n", "café", "\udcff.jpg"]
)
def test_commands_can_be_pasted_whatever_names_they_hold(name):
    said = subprocess.run(
        ["bash", "-c", f"printf %s {quoted(name)}"],
        env={**os.environ, "LC_ALL": "C.UTF-8"}, capture_output=True, check=True,
    )  # fmt: skip
    assert said.stdout == os.fsencode(name)
    assert quoted(name).isprintable()


def test_what_can_be_printed_stays():
    for text in ("Größe 20\u202f°C", "写真 1.jpg", "ε ± 0.1\u00a0K", "می\u200cخواهم"):
        assert SceneError(text).message == text


def test_a_folder_whose_name_is_too_long_is_not_there(tmp_path):
    writer = SceneWriter(tmp_path / "scene")
    content = writer.thermoscenes()
    content["frames"][0]["file_path"] = f"{5_000 * 'f'}/a.png"
    with pytest.raises(SceneError, match=r"transforms\.json.*frame 0") as error:
        load_scene(writer.transforms(content).parent)
    assert len(error.value.message) < 400


def test_a_number_of_too_many_digits_is_one_line(tmp_path):
    path = tmp_path / "survey.yaml"
    for text in ("date: 0x" + 9_000 * "f", "? 0x" + 9_000 * "f" + "\n: 1"):
        path.write_text(text)
        with pytest.raises(ConfigError, match=r"survey\.yaml"):
            read_survey(path)


def test_what_markdown_and_cells_show_can_be_printed():
    for shown in (escape_markdown(EVIL), escape_cell(EVIL.replace("\n", " "))):
        assert shown.isprintable()


@pytest.mark.parametrize("blank", ["", " ", "\t", "\r", "\n", "\u00a0", " \t\n"])
@pytest.mark.parametrize("formula", ["=1+1", "+1", "-1", "@SUM(A1)", "\uff1d1"])
def test_no_cell_is_a_formula(blank, formula):
    assert escape_cell(blank + formula).startswith("'")
    assert escape_cell(f"{blank}H1") == without_controls(f"{blank}H1")


@pytest.mark.parametrize(
    "line",
    [
        "unit" + 400_000 * " ",
        "temp(" + 400_000 * " ",
        100_000 * "unit ",
        200_000 * "° ",
        "[" + 400_000 * " ",
        "in " + 400_000 * " ",
        200_000 * "1 ",
        400_000 * "\t",
        200_000 * "1,",
        200_000 * "\"'",
    ],
)
def test_a_long_line_beside_a_table_costs_little(tmp_path, line):
    """A pattern of quadratic cost would take minutes."""
    path = tmp_path / "photo.csv"
    path.write_text(line + "\n" + 4 * "20.5;21.0;22.5\n", encoding="utf-8")
    assert read_thermal_photo(path).valid.shape == (4, 3)
