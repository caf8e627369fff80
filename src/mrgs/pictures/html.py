"""Pages of one HTML file: templates, pictures inside, and a policy that lets nothing else in."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup
from PIL import Image

from mrgs.pictures.escape import without_controls
from mrgs.system.atomic import write_texts

PAGE_STYLE = "pictures/templates/page.css"
"""Style sheet of all pages that are read like a document."""


class InlineImage(NamedTuple):
    """A picture as a ``data:`` address, which the macro ``image`` of ``parts.html`` shows. ``text``
    is what it shows, for readers who cannot see it."""

    source: Markup
    width: int
    height: int
    text: str


def inline_image(
    image: Image.Image, text: str, *, quality: int = 80, png: bool = False
) -> InlineImage:
    """Encode a picture as JPEG, or as PNG, for use inside a page."""
    buffer, kind = io.BytesIO(), "png" if png else "jpeg"
    image.save(buffer, kind, **({"optimize": True} if png else {"quality": quality}))
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    return InlineImage(Markup(f"data:image/{kind};base64,{content}"), *image.size, text)


def policy_hash(text: str) -> str:
    """Source of a content security policy that allows exactly this script or style."""
    digest = hashlib.sha256(text.encode("utf-8", "replace")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def script_json(value: Any) -> Markup:
    """JSON that cannot end the script element around it."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))


def asset(name: str) -> Markup:
    """Text of a file of the package ``mrgs``, such as a script, by its path inside the package."""
    return Markup(files("mrgs").joinpath(name).read_text(encoding="utf-8"))


def render(template: str, **values: Any) -> Markup:
    """Fill a template, named by its path inside the package ``mrgs``; all text is escaped."""
    return Markup(_environment().get_template(template).render(values))


class Page(NamedTuple):
    """A page of one HTML file, and its content security policy, which the text names too."""

    html: Markup
    policy: str


def make_page(template: str, **values: Any) -> Page:
    """A page whose policy allows its own script and style, and nothing else."""
    values = _filled(**values)
    return Page(render(template, **values), values["policy"])


def _filled(
    *,
    title: str,
    styles: Sequence[str],
    scripts: Sequence[str] = (),
    sources: Sequence[str] = (),
    **values: Any,
) -> dict[str, Any]:
    """The values for a page's template, with its scripts, styles and policy."""
    style = "\n".join(asset(name) for name in styles)
    script = '"use strict";\n' + "\n".join(asset(name) for name in scripts) if scripts else ""
    directives = ["default-src 'none'", "base-uri 'none'", "img-src data:", *sources]
    directives += [f"script-src {policy_hash(script)}"] if script else []
    directives += [f"style-src {policy_hash(style)}"]
    policy = "; ".join(directives)
    own = {"policy": policy, "style": style, "script": script}
    return {
        "title": title,
        "version": version("mrgs"),
        **{name: Markup(text) for name, text in own.items()},
        **values,
    }


def write_html(path: Path, template: str, **values: Any) -> Path:
    """Write a page that needs nothing from the network, and whose policy forbids requests; returns
    the path. For the arguments see ``make_page``; what the template loops over may be an iterator,
    as the file is written as it goes. RunError if it cannot be written."""
    return write_texts(path, _environment().get_template(template).generate(_filled(**values)))


def _finalized(value: Any) -> Any:
    """What a template shows of a value: texts and paths without controls."""
    is_text = isinstance(value, (str, Path)) and not isinstance(value, Markup)
    return without_controls(str(value)) if is_text else value


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("mrgs", "."),
        autoescape=True,
        finalize=_finalized,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
