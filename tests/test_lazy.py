from __future__ import annotations

import importlib
import subprocess
import sys
import zipfile

import pytest


@pytest.mark.parametrize("package", ["mrgs", "mrgs.prepare"])
def test_every_name_can_be_imported_and_is_listed(package):
    module = importlib.import_module(package)
    assert len(module.__all__) >= 8
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert {*module.__all__, "__all__", "lazy_imports"} <= set(dir(module))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match=r"'mrgs' .*'nothing'"):
        _ = importlib.import_module("mrgs").nothing


def test_modules_of_the_package_need_no_import_of_their_own():
    program = "import mrgs; print(mrgs.errors.MrgsError.__name__, mrgs.prepare.__name__)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout == "MrgsError mrgs.prepare\n"


def test_a_package_may_lie_in_a_zip_file(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as file:
        file.writestr(
            "packed_package/__init__.py",
            "from typing import TYPE_CHECKING\n"
            "from mrgs.system.lazy import lazy_imports\n"
            "if TYPE_CHECKING:\n"
            "    from json import dumps as dumps\n"
            "__getattr__, __dir__, __all__ = lazy_imports(__name__)\n",
        )
    monkeypatch.syspath_prepend(tmp_path / "packed.zip")
    assert importlib.import_module("packed_package").dumps([1]) == "[1]"
