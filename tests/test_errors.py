from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import mrgs
from mrgs import errors
from mrgs.errors import MrgsWarning, warn_user

MADE = [
    errors.DamagedCheckpointError(Path("run/step.safetensors"), "cut off"),
    *(
        each("a message", options=("device",))
        for each in vars(errors).values()
        if isinstance(each, type)
        and issubclass(each, errors.MrgsError)
        and each is not errors.DamagedCheckpointError
    ),
]


@pytest.mark.parametrize("error", MADE, ids=lambda error: type(error).__name__)
def test_errors_can_be_handed_to_other_processes(error):
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))


PACKAGE = Path(mrgs.__file__).parent


def defined_in(file: Path, body: str, **names: Any) -> Callable[[], Any]:
    """A function that seems to lie in a file."""
    exec(compile(f"def call():\n    {body}", str(file), "exec"), names)
    return names["call"]


def file_of(call: Callable[[], Any]) -> str:
    """The file at which the call's warning points."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    (warning,) = found
    assert (warning.category, str(warning.message)) == (MrgsWarning, "odd")
    return warning.filename


@pytest.mark.parametrize("name", ["user.py", "mrgs.py", "mrgs_plugin/x.py"])
def test_a_warning_points_at_the_line_outside_of_the_package(name):
    file = PACKAGE.parent / name
    own = defined_in(PACKAGE / "scene/a.py", "warn_user('odd')", warn_user=warn_user)
    outer = defined_in(PACKAGE / "b.py", "inner()", inner=own)
    assert file_of(defined_in(file, "inner()", inner=outer)) == str(file)


def test_a_warning_at_the_beginning_of_a_with_points_at_it():
    opened = contextmanager(
        defined_in(PACKAGE / "a.py", "warn_user('odd'); yield", warn_user=warn_user)
    )

    def call() -> None:
        with opened():
            pass

    assert file_of(call) == __file__
