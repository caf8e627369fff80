from __future__ import annotations

import pytest

from mrgs.pictures.escape import escape_cell, escape_markdown, without_controls


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("frame_eval_00001", "frame_eval_00001"),
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)&gt;"),
        ("a|b\nc\r\nd", "a\\|b c d"),
        ("[text](http://x) www.x.org me@x.org", "\\[text\\](http:\\//x) www\\.x.org me\\@x.org"),
        ("*a* _b_ `c` ~~d~~ $e$", "\\*a\\* \\_b\\_ \\`c\\` \\~\\~d\\~\\~ \\$e\\$"),
        ("# heading", "\\# heading"),
        ("1. item", "1\\. item"),
        ("&amp; \\", "&amp;amp; \\\\"),
    ],
)
def test_what_strangers_wrote_shows_as_it_is(text, escaped):
    assert escape_markdown(text) == escaped


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\uff1d1", "\uff0b1", "\uff0d1", "\uff201"],
)
def test_what_a_spreadsheet_would_run_is_quoted(text):
    assert escape_cell(text) == f"'{without_controls(text)}"


@pytest.mark.parametrize("text", ["", "house", "a=1", "− 3", "'=1"])
def test_other_texts_stay_as_they_are(text):
    assert escape_cell(text) == text
