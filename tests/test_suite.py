"""The tests let the code move: few of them pin whole sentences, and few reach inside to patch."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.helpers.syntax import without_collector

__all__ = ["without_collector"]

TESTS = Path(__file__).parent
FILES = sorted(TESTS.rglob("*.py"))

MOST_SENTENCES = 250
MOST_PATCHES = 100
WORDS = 4
"""A text of so many words is a sentence. An error is tested by its class, by the option, key or
file that it names, and one keyword."""


def text_of(node: ast.AST) -> str:
    """The literal text in an expression, calls and their arguments apart."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.FormattedValue):
        return "x"
    if isinstance(node, ast.Call):
        return ""
    return "".join(map(text_of, ast.iter_child_nodes(node)))


def texts_compared(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Of each ``match=`` and of each comparison in an assert, the text."""
    for node in nodes:
        if isinstance(node, ast.keyword) and node.arg == "match":
            yield text_of(node.value)
        elif isinstance(node, ast.Assert):
            for part in ast.walk(node.test):
                if isinstance(part, ast.Compare):
                    yield max(map(text_of, [part.left, *part.comparators]), key=len)


def sentences(nodes: Iterable[ast.AST]) -> list[str]:
    return [text for text in texts_compared(nodes) if len(text.split()) >= WORDS]


def patches(nodes: Iterable[ast.AST]) -> list[str]:
    """Calls of ``setattr``, and of ``mock.patch`` and of what that offers."""
    return [
        ast.unparse(node)
        for node in nodes
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and (
            node.func.attr in ("setattr", "patch")
            or (isinstance(node.func.value, ast.Attribute) and node.func.value.attr == "patch")
        )
    ]


def counted(found: dict[str, list[str]]) -> dict[str, int]:
    return {name: len(texts) for name, texts in found.items() if texts}


def test_few_assertions_pin_a_whole_sentence_and_few_tests_patch_what_is_inside():
    pinned, patched = {}, {}
    for path in FILES:
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        name = path.relative_to(TESTS).as_posix()
        pinned[name], patched[name] = sentences(nodes), patches(nodes)
    assert sum(counted(pinned).values()) <= MOST_SENTENCES, counted(pinned)
    assert sum(counted(patched).values()) <= MOST_PATCHES, counted(patched)


def test_the_counts_can_fail():
    pinned = (
        "with raises(E, match='a b c d'):\n    pass\nassert text == f'a {b} c d'\nassert 'a b' in x"
    )
    assert len(sentences(ast.walk(ast.parse(pinned)))) == 2
    patched = "monkeypatch.setattr(a, 'b', 1)\nmock.patch('a.b')\nmock.patch.object(a, 'b')"
    assert len(patches(ast.walk(ast.parse(patched)))) == 3
