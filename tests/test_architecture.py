from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import room_map
from room_map import nodes
from tests.helpers.syntax import without_collector

__all__ = ["without_collector"]

SOURCE = Path(__file__).parents[1] / "src" / "mrgs"
FILES = {path.relative_to(SOURCE).as_posix(): path for path in sorted(SOURCE.rglob("*.py"))}
PLUGINS = Path(__file__).parents[1] / "plugins"
ALL_FILES = FILES | {
    path.relative_to(PLUGINS.parent).as_posix(): path for path in sorted(PLUGINS.rglob("*.py"))
}

FLOORS = {
    "errors": 0,
    "system": 1,
    "scene": 2,
    "survey": 2,
    "data": 3,
    "field": 3,
    "rasterizer": 3,
    "pictures": 3,
    "render": 4,
    "check": 4,
    "method": 5,
    "prepare": 5,
    "kernels": 6,
    "run_files": 4,
    "training": 6,
    "blocks": 7,
    "runs": 7,
    "mrgs_thermonerf": 8,
    "mrgs_compare": 9,
    "evaluation": 8,
    "marks": 8,
    "maps": 8,
    "export": 9,
    "viewer": 9,
    "report": 9,
    "pipeline": 10,
    "app": 11,
    "__main__": 12,
}
"""A file imports from strictly lower floors and from its own room; ``mrgs`` itself imports on first
use, from any. No file of ``mrgs`` imports from the plugins."""

FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve"}
FORBIDDEN_ATTRIBUTES = {
    ("torch", "load"),
    ("torch", "save"),
    ("yaml", "load"),
    ("yaml", "load_all"),
    ("yaml", "unsafe_load"),
    ("yaml", "full_load"),
    ("os", "system"),
    ("os", "popen"),
}


BUDGET = {"lines": 60_000, "files": 335, "floors": 12}
"""What ``src/mrgs`` may have at most: a new feature folds or deletes as much as it adds."""


def room_of(dotted: str) -> str:
    """The room of ``mrgs.room.module``, and of a plugin's module; empty for ``mrgs`` itself."""
    top, *below = dotted.split(".")
    return [*below, ""][0] if top == "mrgs" else top


@cache
def imported_modules(tree: ast.AST) -> list[str]:
    """Absolute names of everything that a file imports, wherever in the file; ``from a import b``
    gives ``a.b``."""
    names = []
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute, so that the floors can be read off them"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def parse(name: str) -> ast.Module:
    return room_map.tree(ALL_FILES[name])


def misplaced_imports(room: str, tree: ast.AST) -> list[str]:
    """Imports that do not point downwards."""
    ours = ("mrgs", *(path.name for path in PLUGINS.glob("*/src/*")))
    targets = {name: room_of(name) for name in imported_modules(tree) if name.split(".")[0] in ours}
    return [
        name
        for name, target in targets.items()
        if target != room and not FLOORS[target] < FLOORS[room]
    ]


def breaches(tree: ast.AST) -> list[str]:
    """Everything in a file that could run what it reads."""
    found = [name for name in imported_modules(tree) if name.split(".")[0] in FORBIDDEN_MODULES]
    found += [
        name
        for name in imported_modules(tree)
        if tuple(name.rsplit(".", 1)) in FORBIDDEN_ATTRIBUTES
    ]
    for node in nodes(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in FORBIDDEN_CALLS
        ):
            found.append(node.func.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in FORBIDDEN_ATTRIBUTES:
                found.append(f"{node.value.id}.{node.attr}")
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            found.append("allow_pickle")
    return found


def prints(tree: ast.AST) -> bool:
    return any(
        isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
        for node in nodes(tree)
    )


def found_in_files(search: Callable[[str], object]) -> dict[str, object]:
    """What a search finds, of the files in which it finds anything."""
    return {name: found for name in ALL_FILES if (found := search(name))}


def test_imports_point_downwards():
    rooms = {name: name.removesuffix(".py").split("/") for name in ALL_FILES}
    rooms = {name: path[3 if path[0] == "plugins" else 0] for name, path in rooms.items()}
    del rooms["__init__.py"]
    assert set(rooms.values()) - FLOORS.keys() == set(), "give each room a floor"
    found = {name: misplaced_imports(room, parse(name)) for name, room in rooms.items()}
    assert {name: imports for name, imports in found.items() if imports} == {}


@pytest.mark.parametrize(
    ("room", "line"),
    [
        ("data", "from mrgs.field import RadianceField"),
        ("scene", "from mrgs import training"),
        ("evaluation", "from mrgs.viewer import view"),
        ("training", "def f():\n    from mrgs.app.cli import main"),
        ("runs", "from mrgs.evaluation.evaluate import score"),
        ("runs", "from mrgs_thermonerf.run import open_thermonerf"),
        ("mrgs_thermonerf", "from mrgs.app.cli import main"),
        ("mrgs_compare", "from mrgs.app.cli import main"),
    ],
)
def test_the_check_of_imports_can_fail(room, line):
    assert misplaced_imports(room, ast.parse(line))


def test_nothing_runs_what_it_reads():
    assert found_in_files(lambda name: breaches(parse(name))) == {}


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from torch import load",
        "torch.load(path)",
        "yaml.load(text)",
        "eval(text)",
        "np.load(p, allow_pickle=True)",
    ],
)
def test_the_check_of_what_is_run_can_fail(line):
    assert breaches(ast.parse(line))


def test_only_the_command_line_prints():
    found = found_in_files(lambda name: prints(parse(name)))
    assert [name for name in found if not name.startswith("app/")] == []


OTHER_PROGRAMS = {
    "system/gpu.py": "pip's options",
    "data/radiometric/dji.py": "dji_irp's options",
    "prepare/sfm/__main__.py": "started by prepare alone",
}


def options_named(tree: ast.AST) -> list[str]:
    """Texts, docstrings apart, that name an option of a command line."""
    expressions = {id(node.value) for node in nodes(tree) if isinstance(node, ast.Expr)}
    return [
        node.value
        for node in nodes(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in expressions
        and re.search(r"(^|[\s(`'\"])--[a-z]", node.value)
    ]


def test_only_the_command_line_speaks_of_options():
    found = found_in_files(lambda name: options_named(parse(name)))
    ours = {name: options for name, options in found.items() if not name.startswith("app/")}
    assert ours.keys() - OTHER_PROGRAMS == set(), ours


def test_the_check_of_options_can_fail():
    assert options_named(ast.parse('raise ConfigError("choose another --output")'))


def test_no_two_classes_have_the_same_name():
    defined = Counter(
        node.name
        for name in ALL_FILES
        for node in nodes(parse(name))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in defined.items() if count > 1] == []


@pytest.mark.parametrize("module", ["mrgs", "mrgs.app.cli", "mrgs_thermonerf"])
def test_importing_is_cheap(module):
    """torch takes seconds to load: ``mrgs --help`` must not."""
    script = (
        f"import sys, {module}; print(*sorted({{'torch', 'numba', 'scipy'}} & set(sys.modules)))"
    )
    path = [str(SOURCE.parent), *filter(None, sys.path)]
    run = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {path!r}; {script}"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout.split() == []


def test_the_package_stays_within_its_budget():
    size = {
        "lines": sum(path.read_bytes().count(b"\n") for path in FILES.values()),
        "files": len(FILES),
        "floors": 1 + max(room_map.floors(room_map.imports()).values()),
    }
    assert {name: value for name, value in size.items() if value > BUDGET[name]} == {}


def test_the_map_lists_every_package_once_and_its_picture_is_new():
    listed = sorted(room for rooms in room_map.groups().values() for room in rooms)
    assert listed == sorted(room_map.imports())
    assert room_map.PICTURE.read_text(encoding="utf-8") == room_map.picture(), (
        "run python tools/room_map.py"
    )
