"""A PDF on systems that lack what WeasyPrint finds outside of Python."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

HIDE_AND_WRITE = """
import sys
from pathlib import Path

import cffi

hidden = "nothing yet"
load = cffi.FFI.dlopen

def dlopen(self, name, *flags):
    if name and hidden in name:
        raise OSError(f"cannot load library {name!r}")
    return load(self, name, *flags)

cffi.FFI.dlopen = dlopen

from mrgs.errors import ConfigError
from mrgs.report.write import write_pdf

page = Path(sys.argv[1])
for hidden in ("pango", "harfbuzz-subset"):
    for name in [name for name in sys.modules if name.split(".")[0] == "weasyprint"]:
        del sys.modules[name]
    try:
        write_pdf(page, page.with_name(f"without-{hidden}.pdf"))
    except ConfigError as error:
        print(error, file=sys.stderr)
"""

pytestmark = pytest.mark.skipif(
    find_spec("weasyprint") is None, reason="weasyprint is not installed"
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Where PDFs were written where a library is missing and every warning is an error, and the
    lines that were said; one process for all, because it loads torch."""
    page = tmp_path_factory.mktemp("pdf") / "report.html"
    page.write_text("<h1>Report</h1>", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", HIDE_AND_WRITE, str(page)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return page.parent, done.stderr.splitlines()


@pytest.mark.usefixtures("pango")
def test_without_harfbuzz_subset_the_pdf_is_written_all_the_same(written):
    folder, said = written
    assert said[1:] == []
    assert (folder / "without-harfbuzz-subset.pdf").read_bytes().startswith(b"%PDF")


def test_without_pango_one_line_names_the_packages_to_install(written):
    folder, said = written
    assert "apt install libpango-1.0-0" in said[0]
    assert not (folder / "without-pango.pdf").exists()
