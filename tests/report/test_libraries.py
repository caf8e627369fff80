"""A PDF on systems that lack what WeasyPrint finds outside of Python."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from mrgs.errors import ConfigError
from mrgs.report.copies import write_copies

pytestmark = pytest.mark.skipif(
    find_spec("weasyprint") is None, reason="weasyprint is not installed"
)


@pytest.fixture
def write_without(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[str], Path]]:
    """Writes a page as PDF where a library cannot be loaded, and returns where."""
    cffi = pytest.importorskip("cffi")
    load = cffi.FFI.dlopen
    hidden = ""

    def dlopen(self, name, *flags):
        if name and hidden in name:
            raise OSError(f"cannot load library {name!r}")
        return load(self, name, *flags)

    def write(library: str) -> Path:
        nonlocal hidden
        hidden = library
        page = tmp_path / "report.html"
        page.write_text("<h1>Report</h1>", encoding="utf-8")
        (path,) = write_copies(page, pdf=True)
        return path

    monkeypatch.setattr(cffi.FFI, "dlopen", dlopen)
    for name in [name for name in sys.modules if name.split(".")[0] == "weasyprint"]:
        monkeypatch.delitem(sys.modules, name)
    yield write
    for name in [name for name in sys.modules if name.split(".")[0] == "weasyprint"]:
        del sys.modules[name]


@pytest.mark.usefixtures("pango")
def test_without_harfbuzz_subset_the_pdf_is_written_all_the_same(write_without):
    assert write_without("harfbuzz-subset").read_bytes().startswith(b"%PDF")


def test_without_pango_one_line_names_the_packages_to_install(write_without, tmp_path):
    with pytest.raises(ConfigError, match="apt install libpango") as caught:
        write_without("pango")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.pdf").exists()
