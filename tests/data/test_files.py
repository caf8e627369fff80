from __future__ import annotations

import os
from pathlib import Path

import pytest

from mrgs.data.files import ImageFinder, contained, read_bytes, visible_files, without_image_suffix
from mrgs.errors import SceneError


@pytest.mark.parametrize(
    ("name", "stem"),
    [("a.JPG", "a"), ("x/a.b.png", "x/a.b"), ("r_0.5", "r_0.5"), ("a", "a"), ("a.ply", "a.ply"),
     (".png", ".png"), ("x/.png", "x/.png")],
)  # fmt: skip
def test_only_image_extensions_are_cut(name, stem):
    assert without_image_suffix(name) == stem


def test_images_are_found_by_stem(tmp_path):
    root = tmp_path.resolve()
    (root / "images").mkdir()
    for name in ("a.PNG", "b.jpg", "b.png", "c.txt"):
        (root / "images" / name).write_text("")
    finder = ImageFinder(root)
    assert finder.find("images/a.jpg", "f").name == "a.PNG"
    assert finder.find("images/a", "f").name == "a.PNG"
    assert finder.find("images/b.png", "f").name == "b.png"
    assert finder.find("images\\b", "f").name == "b.png"
    assert finder.find("images/c", "f") is None
    assert finder.find("nowhere/a", "f") is None


@pytest.mark.parametrize(
    "relative", ["../a", "a/../../b", "..", "..\\a", "/etc/passwd", "\\etc\\passwd"]
)
def test_a_path_that_leaves_the_folder_is_refused(tmp_path, relative):
    with pytest.raises(SceneError, match=r"^cameras\.json: .* leaves"):
        contained(tmp_path.resolve(), relative, "cameras.json")


def test_paths_are_named_from_the_folder_on_whatever_their_slashes(tmp_path):
    root = tmp_path.resolve()
    assert contained(root, "images\\a.jpg", "f") == root / "images" / "a.jpg"
    assert contained(root, "images/../a.jpg", "f").resolve() == root / "a.jpg"
    assert contained(root, f"{root}/a.jpg", "f") == root / "a.jpg"
    with pytest.raises(SceneError, match=r"^f: .* leaves"):
        contained(root, f"{root.parent}/a.jpg", "f")


@pytest.mark.parametrize("relative", ["a\0b", "a\0b/c"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, relative):
    with pytest.raises(SceneError, match=r"^f: .* usable"):
        contained(tmp_path.resolve(), relative, "f")
    with pytest.raises(SceneError, match=r"^f: .* usable"):
        ImageFinder(tmp_path.resolve()).find(relative, "f")


def test_no_image_is_found_outside_of_the_scene_whatever_was_found_before(tmp_path):
    root = (tmp_path / "scene").resolve()
    root.mkdir()
    (root / "a.jpg").write_text("")
    (tmp_path / "b.jpg").write_text("")
    (root / "b.jpg").symlink_to(tmp_path / "b.jpg")
    finder = ImageFinder(root)
    assert finder.find("a.jpg", "f") == root / "a.jpg"
    for name in ("/a.jpg", "\\a.jpg", "../b.jpg", "b.jpg", "b"):
        with pytest.raises(SceneError, match=r"^f: .* leaves"):
            finder.find(name, "f")


def test_entries_that_are_no_images_do_not_hide_the_others(tmp_path):
    root = tmp_path.resolve()
    (root / "images" / "folder.jpg").mkdir(parents=True)
    (root / "images" / "a.jpg").write_text("")
    (root / "images" / "itself.jpg").symlink_to("itself.jpg")
    (root / "images" / "nowhere.jpg").symlink_to("nothing.jpg")
    finder = ImageFinder(root)
    assert finder.find("images/a.jpg", "f").name == "a.jpg"
    for name in ("folder.jpg", "itself.jpg", "nowhere.jpg", "a" * 300 + ".jpg"):
        assert finder.find(f"images/{name}", "f") is None
    assert list(finder.tree(root / "images")) == ["a"]
    assert finder.find("a" * 300 + "/a.jpg", "f") is None


def test_a_folder_of_images_that_may_not_be_listed_is_named(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    root = tmp_path.resolve()
    (root / "images").mkdir()
    for name in ("scandir", "listdir"):
        monkeypatch.setattr(os, name, refuse)
    with pytest.raises(SceneError, match=r"images: .*[Pp]ermission"):
        ImageFinder(root).tree(root / "images")


def test_hidden_files_are_skipped_and_linked_folders_not_entered(tmp_path):
    for name in ("a.jpg", "._a.jpg", ".hidden/b.jpg", "sub/c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "again").symlink_to(tmp_path)
    (tmp_path / ".again").symlink_to(tmp_path)
    names = sorted(path.relative_to(tmp_path).as_posix() for path in visible_files(tmp_path))
    assert names == ["a.jpg", "again", "sub/c.jpg"]
    with pytest.raises(SceneError, match="nowhere: cannot"):
        list(visible_files(Path(tmp_path / "nowhere")))


def test_files_are_read_up_to_a_limit(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", limit=5) == b"12345"
    with pytest.raises(SceneError, match="limit of 4"):
        read_bytes(tmp_path / "a", limit=4)
    with pytest.raises(SceneError, match="b: cannot"):
        read_bytes(tmp_path / "b")
    with pytest.raises(SceneError, match="cannot be read"):
        read_bytes(tmp_path)
