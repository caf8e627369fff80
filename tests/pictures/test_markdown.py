from __future__ import annotations

import pytest

from mrgs.pictures.markdown import escape_markdown


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
