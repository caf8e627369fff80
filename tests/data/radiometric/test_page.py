"""The code of docs/radiometric.md runs as it stands there."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

from tests.helpers.flir import FlirPhoto

PAGE = (Path(__file__).parents[3] / "docs" / "radiometric.md").read_text(encoding="utf-8")


def test_the_code_reads_a_photo(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("IR_0001.jpg").write_bytes(FlirPhoto().jpeg())
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    Path("page.py").write_text(code, encoding="utf-8")
    photo = runpy.run_path("page.py")["photo"]
    assert photo.temperature_c.shape == photo.valid.shape
    assert (photo.facts.parameters.emissivity, photo.facts.parameters.reflected_c) == (0.93, -5.0)
