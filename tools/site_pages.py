"""Pages of the documentation site that are not in docs/: the README and its like, and the reference
of the Python API. A hook of mkdocs."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]

PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "examples/README.md": "examples.md",
    "benchmarks/results/results.md": "results.md",
    "benchmarks/results/gpu.md": "results-gpu.md",
    "benchmarks/results/growth/growth.md": "results-growth.md",
    "benchmarks/results/quality/quality.md": "results-quality.md",
}
"""Files of the repository, and the pages that they become."""

FILES = {
    "benchmarks/results/chart.png": "images/chart.png",
    "benchmarks/results/growth/growth.png": "images/growth.png",
    "benchmarks/results/quality/quality.png": "images/quality.png",
    "benchmarks/results/gpu_resources.json": "gpu_resources.json",
}

REFERENCE = "reference.md"

_LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add what lies outside of docs/, and the reference."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=relinked(text, source, page)))
    for source, target in FILES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_bytes()))
    files.append(File.generated(config, REFERENCE, content=reference()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links out of docs/ to where the site has their targets."""
    name = page.file.src_uri
    if name in PAGES.values() or name == REFERENCE:
        return markdown
    return relinked(markdown, f"docs/{name}", name)


def relinked(text: str, source: str, page: str) -> str:
    """Markdown with its relative links as the site needs them.

    Args:
        text: of a file of the repository.
        source: the file's path in the repository.
        page: its path on the site.
    """
    moved = {(ROOT / old).resolve(): new for old, new in (PAGES | FILES).items()}
    up = "../" * page.count("/")

    def replace(link: re.Match[str]) -> str:
        target = (ROOT / source).parent.joinpath(link[1]).resolve()
        if target in moved:
            place = moved[target]
        elif target.is_relative_to(ROOT / "docs"):
            place = target.relative_to(ROOT / "docs").as_posix()
        else:
            return link[0]
        if target.is_dir():
            place += "/README.md"
        return f"]({up}{place}{link[2] or ''})"

    return _LINK.sub(replace, text)


def reference() -> str:
    """A page with every name that ``mrgs`` exports, in the order of its ``__init__.py``."""
    tree = ast.parse((ROOT / "src" / "mrgs" / "__init__.py").read_text(encoding="utf-8"))
    names = [
        f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    ]
    entries = "\n\n".join(f"::: {name}" for name in [*names, "mrgs.prepare.prepare"])
    return f"# Reference\n\nEverything here is imported from `mrgs`.\n\n{entries}\n"
