from __future__ import annotations

import sys
from base64 import b64encode

import pytest
from PIL import Image, ImageFile

from mrgs.errors import ConfigError
from mrgs.report.copies import write_copies


@pytest.mark.usefixtures("pango")
def test_a_page_becomes_a_pdf_and_nothing_is_fetched(tmp_path):
    secret = tmp_path / "secret.css"
    secret.write_text("h1 { color: red }", encoding="utf-8")
    page = tmp_path / "report.html"
    page.write_text(
        f"<link rel=stylesheet href='{secret.as_uri()}'><h1>Report</h1><img src='http://a.invalid/b'>",
        encoding="utf-8",
    )
    (path,) = write_copies(page, pdf=True)
    assert path.read_bytes().startswith(b"%PDF")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "report.html", "report.pdf", "secret.css",
    ]  # fmt: skip
    assert not ImageFile.LOAD_TRUNCATED_IMAGES


@pytest.mark.usefixtures("pango")
def test_no_file_beside_the_page_comes_into_a_pdf(tmp_path):
    picture, page = tmp_path / "secret.png", tmp_path / "report.html"
    Image.new("RGB", (20, 10), (250, 10, 10)).save(picture)
    inside = "data:image/png;base64," + b64encode(picture.read_bytes()).decode()
    for source, is_shown in ((inside, True), (picture.as_uri(), False), ("secret.png", False)):
        page.write_text(f"<h1>Report</h1><img src='{source}'>", encoding="utf-8")
        (path,) = write_copies(page, pdf=True)
        assert (b"/Subtype /Image" in path.read_bytes()) == is_shown


def test_without_weasyprint_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(ConfigError, match=r'pip install "mrgs\[report\]"'):
        write_copies(tmp_path / "report.html", pdf=True)
