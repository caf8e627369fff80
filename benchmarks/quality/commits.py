"""The code of other commits, checked out beside the working tree for as long as it is needed."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.quality.plan import WORKING_TREE

ROOT = Path(__file__).parents[2]


@contextmanager
def sources(commits: Iterable[str]) -> Iterator[dict[str, Path]]:
    """The folder to import ``mrgs`` from, by commit.

    Raises:
        subprocess.CalledProcessError: git knows no such commit.
    """
    found = {WORKING_TREE: ROOT / "src"}
    with TemporaryDirectory() as folder:
        try:
            for commit in dict.fromkeys(commits):
                if commit != WORKING_TREE:
                    place = Path(folder) / str(len(found))
                    _git("worktree", "add", "--quiet", "--detach", str(place), commit)
                    found[commit] = place / "src"
            yield found
        finally:
            for commit, source in found.items():
                if commit != WORKING_TREE:
                    _git("worktree", "remove", "--force", str(source.parent))


def _git(*arguments: str) -> None:
    subprocess.run(["git", "-C", str(ROOT), *arguments], check=True)
