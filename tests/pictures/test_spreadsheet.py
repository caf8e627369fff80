from __future__ import annotations

import pytest

from mrgs.pictures.spreadsheet import escape_cell


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\uff1d1", "\uff0b1", "\uff0d1", "\uff201"],
)
def test_what_a_spreadsheet_would_run_is_quoted(text):
    assert escape_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["", "house", "a=1", "− 3", "'=1"])
def test_other_texts_stay_as_they_are(text):
    assert escape_cell(text) == text
