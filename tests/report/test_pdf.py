from __future__ import annotations

import sys

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
    sizes = []
    for source in ("data:,", picture.as_uri(), "secret.png"):
        page.write_text(f"<h1>Report</h1><img src='{source}'>", encoding="utf-8")
        (path,) = write_copies(page, pdf=True)
        content = path.read_bytes()
        assert b"/Subtype /Image" not in content
        sizes.append(len(content))
    assert len(set(sizes)) == 1


def test_without_weasyprint_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(ConfigError, match=r'pip install "mrgs\[report\]"'):
        write_copies(tmp_path / "report.html", pdf=True)
