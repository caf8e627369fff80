from __future__ import annotations

import importlib

import pytest


@pytest.mark.parametrize("package", ["mrgs", "mrgs.prepare"])
def test_every_name_can_be_imported(package):
    module = importlib.import_module(package)
    assert len(module.__all__) >= 8
    for name in module.__all__:
        assert getattr(module, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'mrgs' has no attribute 'nothing'"):
        _ = importlib.import_module("mrgs").nothing
