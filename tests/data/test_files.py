from __future__ import annotations

import pytest

from mrgs.data.files import ImageFinder, read_bytes, without_image_suffix
from mrgs.errors import SceneError


@pytest.mark.parametrize(
    ("name", "stem"),
    [("a.JPG", "a"), ("x/a.b.png", "x/a.b"), ("r_0.5", "r_0.5"), ("a", "a"), ("a.ply", "a.ply")],
)
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
    assert finder.find("images\\b", "f").name == "b.jpg"
    assert finder.find("images/c", "f") is None
    assert finder.find("nowhere/a", "f") is None


def test_files_are_read_up_to_a_limit(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", limit=5) == b"12345"
    with pytest.raises(SceneError, match="is 5 bytes long, more than the limit of 4"):
        read_bytes(tmp_path / "a", limit=4)
    with pytest.raises(SceneError, match="b: cannot be read"):
        read_bytes(tmp_path / "b")
    with pytest.raises(SceneError, match="is not a file"):
        read_bytes(tmp_path)
