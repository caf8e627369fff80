"""A PDF on systems that lack what WeasyPrint finds outside of Python."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.helpers.pdf import needs_pango

HIDE_AND_WRITE = """
import sys
from pathlib import Path

import cffi

hidden, page = sys.argv[1:]
load = cffi.FFI.dlopen

def dlopen(self, name, *flags):
    if name and hidden in name:
        raise OSError(f"cannot load library {name!r}")
    return load(self, name, *flags)

cffi.FFI.dlopen = dlopen

from mrgs.errors import ConfigError
from mrgs.report.write import write_pdf

try:
    write_pdf(Path(page), Path(page).with_suffix(".pdf"))
except ConfigError as error:
    sys.exit(str(error))
"""

pytestmark = pytest.mark.skipif(
    find_spec("weasyprint") is None, reason="weasyprint is not installed"
)


def write_without(library: str, page: Path) -> subprocess.CompletedProcess[str]:
    """Write a PDF where a library is missing and every warning is an error."""
    page.write_text("<h1>Report</h1>", encoding="utf-8")
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", HIDE_AND_WRITE, library, str(page)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@needs_pango
def test_without_harfbuzz_subset_the_pdf_is_written_all_the_same(tmp_path: Path) -> None:
    done = write_without("harfbuzz-subset", tmp_path / "report.html")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_without_pango_one_line_names_the_packages_to_install(tmp_path: Path) -> None:
    done = write_without("pango", tmp_path / "report.html")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "apt install libpango-1.0-0" in done.stderr
    assert not (tmp_path / "report.pdf").exists()
