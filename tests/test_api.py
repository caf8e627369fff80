"""Every snippet of docs/api.md runs, and is typed, as it stands there."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
"""One program: later snippets use the names of earlier ones."""


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All snippets in one file, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "snippets.py"
    file.write_text("\n".join(SNIPPETS), encoding="utf-8")
    return file


@pytest.mark.slow
def test_the_snippets_run_one_after_the_other(
    program: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = runpy.run_path(str(program))
    printed = capsys.readouterr().out
    assert "Scene('scene', 14 training + 2 evaluation views, RGB + thermal, 21 to 60 °C" in printed
    assert "Run(mrgs-plus, step 20, 500 Gaussians)" in printed
    assert names["colors"].shape == (240, 320, 3)
    assert names["run"].gaussian_count <= 400
    assert names["page"].is_file()
    assert names["paths"]
    assert names["run"].temperature_at(names["points"]).isnan().tolist()[1]


def check_types(file: Path) -> str:
    """The complaints of mypy."""
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "mypy",
            f"--config-file={ROOT / 'pyproject.toml'}",
            f"--cache-dir={ROOT / '.mypy_cache'}",
            str(file),
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=os.environ | {"MYPYPATH": "src"},
    )
    assert run.returncode in (0, 1), run.stderr
    return run.stdout


@pytest.mark.slow
def test_the_snippets_are_typed(program: Path) -> None:
    assert check_types(program).startswith("Success: no issues found in 1 source file")
    program.write_text(program.read_text() + "\nrun.temperature_at(camera)\n")
    assert "Argument 1" in check_types(program), "the check can fail"
