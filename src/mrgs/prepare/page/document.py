"""One HTML file with everything in it: it asks the network for nothing, and its policy forbids
to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from mrgs.system.atomic import replacing
from mrgs.system.webpage import policy_hash, script_json

SCRIPTS = ("orbit.js", "pairs.js", "measure.js", "page.js")


def write_document(
    path: Path, title: str, subtitle: str, sections: Sequence[str], facts: Mapping[str, Any]
) -> Path:
    """Write the page; returns its path.

    Args:
        path: ends with .html.
        title: plain text.
        subtitle: plain text.
        sections: HTML, in order.
        facts: what the scripts read, JSON.

    Raises:
        RunError: the file cannot be written.
    """
    script = '"use strict";\n' + "\n".join(_asset(name) for name in SCRIPTS)
    style = _asset("page.css")
    page = Template(_asset("page.html")).substitute(
        title=escape(title),
        subtitle=escape(subtitle),
        version=escape(version("mrgs")),
        sections="\n".join(section for section in sections if section),
        facts=script_json(facts),
        style=style,
        style_hash=policy_hash(style),
        script=script,
        script_hash=policy_hash(script),
    )
    with replacing(path) as temporary:
        temporary.write_text(
            page, encoding="utf-8", errors="replace"
        )  # names of files need not be valid text
    return path


def _asset(name: str) -> str:
    return files("mrgs.prepare.page").joinpath(name).read_text(encoding="utf-8")
