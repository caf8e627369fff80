"""What is uploaded: the wheel and the sdist, their content, size and metadata."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from email.message import Message
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import mrgs
from tests.helpers.runs import made_once

ROOT = Path(__file__).parents[1]
LARGEST_MIB = 12
"""Of either file; the bundled scene is nearly all of it."""

FOR_DEVELOPERS = {"bench", "dev", "docs"}
"""Extras that `make` installs."""


def build(folder: Path) -> None:
    """Build both from the files that git knows, so that a checkout's leftovers do not count."""
    source = folder / "source"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split("\0")  # fmt: skip
    for name in filter(None, listed):
        wanted = "/" not in name or name.startswith(("src/", "examples/"))
        if wanted and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist")]
    done = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with both."""
    pytest.importorskip("hatchling")
    pytest.importorskip("hatch_fancy_pypi_readme")
    return made_once(tmp_path_factory, "packages", build) / "dist"


def names_in_wheel(dist: Path) -> set[str]:
    (wheel,) = dist.glob("*.whl")
    return set(zipfile.ZipFile(wheel).namelist())


def metadata_of(dist: Path) -> Message:
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [each for each in archive.namelist() if each.endswith(".dist-info/METADATA")]
        return message_from_bytes(archive.read(name))


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_the_bundled_scene_alone(dist: Path) -> None:
    modules = {
        f"mrgs/{path.relative_to(ROOT / 'src' / 'mrgs').as_posix()}"
        for path in (ROOT / "src" / "mrgs").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    scene = {
        f"mrgs/examples/{path.relative_to(ROOT / 'examples').as_posix()}"
        for path in (ROOT / "examples" / "tabletop").rglob("*")
        if path.is_file()
    }
    found = {name for name in names_in_wheel(dist) if ".dist-info/" not in name}
    assert found == modules | scene
    assert "mrgs/py.typed" in found


@pytest.mark.slow
def test_the_sdist_builds_the_wheel_and_holds_nothing_else(dist: Path) -> None:
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        tops = {name.split("/")[1] for name in archive.getnames() if name.count("/")}
    assert tops == {
        ".gitignore",
        "CHANGELOG.md",
        "CITATION.cff",
        "LICENSE",
        "PKG-INFO",
        "README.md",
        "examples",
        "pyproject.toml",
        "src",
    }


@pytest.mark.slow
def test_both_are_small(dist: Path) -> None:
    sizes = {path.name: path.stat().st_size / 2**20 for path in dist.iterdir()}
    assert len(sizes) == 2
    assert max(sizes.values()) < LARGEST_MIB


@pytest.mark.slow
def test_the_metadata_is_whole(dist: Path) -> None:
    metadata = metadata_of(dist)
    assert metadata["Version"] == mrgs.__version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.10"
    assert metadata["Keywords"].count(",") >= 4
    urls = dict(text.split(", ") for text in metadata.get_all("Project-URL", []))
    assert urls.keys() >= {"Homepage", "Repository", "Changelog"}
    versions = {
        text.rpartition(" ")[2]
        for text in metadata.get_all("Classifier", [])
        if "Python :: 3." in text
    }
    assert versions == {"3.10", "3.11", "3.12", "3.13"}


@pytest.mark.slow
def test_the_readme_names_every_extra_of_users(dist: Path) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme.split("| extra | for |")[1].split("\n\n")[0]
    extras = set(metadata_of(dist).get_all("Provides-Extra", []))
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == extras - FOR_DEVELOPERS


@pytest.mark.slow
def test_the_readme_leads_somewhere_from_a_package_index(dist: Path) -> None:
    readme = str(metadata_of(dist).get_payload())
    targets = re.findall(r"\]\(([^)]+)\)", readme)
    assert len(targets) > 10
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert not re.search(r"<img[^>]+src=\"(?!https:)", readme)


@pytest.mark.slow
def test_extras_do_not_repeat_what_the_core_brings(dist: Path) -> None:
    required = metadata_of(dist).get_all("Requires-Dist", [])
    names = {bool("extra ==" in text): set() for text in required}  # of the core, and of the extras
    for text in required:
        names["extra ==" in text].add(re.split(r"[^A-Za-z0-9_.-]", text)[0].lower())
    assert names[False] & names[True] == set()


def test_one_version_everywhere() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE)[1] == mrgs.__version__
    assert re.search(r"^## \[(.*?)\]", changelog, re.MULTILINE)[1] == mrgs.__version__
    for plugin in ROOT.glob("plugins/*/pyproject.toml"):
        text = plugin.read_text(encoding="utf-8")
        assert re.search(r"^version = \"(.*)\"$", text, re.MULTILINE)[1] == mrgs.__version__


def pinned() -> dict[str, str]:
    """Package and version, of the lines of constraints.txt that are meant for this machine."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines]
    return {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin in pins
        if pin.marker is None or pin.marker.evaluate()
    }


def installed_with(package: str, extras: frozenset[str], seen: dict[str, str]) -> dict[str, str]:
    """Everything installed that ``package[extras]`` requires, directly or not, with its version."""
    for text in requires(package) or []:
        needed = Requirement(text)
        name = canonicalize_name(needed.name)
        wanted = needed.marker is None or any(
            needed.marker.evaluate({"extra": extra}) for extra in extras | {""}
        )
        if not wanted or (name in seen and not needed.extras):
            continue
        try:
            seen[name] = version(name).partition("+")[0]  # 2.13.0+cpu is a build of 2.13.0
        except PackageNotFoundError:
            continue  # of an extra that is not installed
        installed_with(name, frozenset(needed.extras), seen)
    return seen


@pytest.mark.pins
def test_what_is_installed_is_what_is_pinned() -> None:
    """`make pins` pins what is new; `pytest -m "not pins"` is for other versions."""
    found = installed_with("mrgs", frozenset(FOR_DEVELOPERS), {})
    found.pop("mrgs", None)
    assert len(found) > 50
    assert found.items() - pinned().items() == set()


def test_pins_name_packages_and_no_places() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert not re.search(r"://|^-|@", text, re.MULTILINE)
