from __future__ import annotations

from dataclasses import asdict

import pytest

from mrgs.errors import ConfigError
from mrgs.system.strict_yaml import flat, write_yaml
from mrgs_compare.plan import Variant, configure, from_text
from tests.helpers.comparison import tiny_options


def changes(variant, options):
    """What a variant's configuration has of its own, against the method's."""
    usual, other = (
        flat(asdict(configure(Variant("", variant.method), options, 4))),
        flat(asdict(configure(variant, options, 4))),
    )
    assert usual["seed"] == other["seed"] == 4
    return {name: other[name] for name in usual if usual[name] != other[name]}


def test_a_variant_differs_from_its_method_by_what_its_text_says():
    text = "{method: mrgs, seed: 7, densification: {max_gaussians: 90}, field: {neighbours_n: 5}}"
    variant = Variant.from_text("wide", text, "wide.yaml")
    assert (variant.name, variant.method) == ("wide", "mrgs")
    assert changes(variant, tiny_options()) == {
        "densification.max_gaussians": 90,
        "field.neighbours_n": 5,
    }


def test_a_variant_of_thermonerf():
    variant = Variant.from_text("few rays", "{method: thermonerf, rays_per_batch: 64}", "few.yaml")
    assert changes(variant, tiny_options()) == {"rays_per_batch": 64}


@pytest.mark.parametrize("text", ["3", "{seed: 1}", "{method: 3}"])
def test_a_variant_names_its_method(text):
    with pytest.raises(ConfigError, match=r"wide\.yaml .*method: mrgs"):
        Variant.from_text("wide", text, "wide.yaml")


def test_a_misspelt_value_of_a_variant():
    with pytest.raises(ConfigError, match=r"wide\.yaml: .*'sed'"):
        configure(
            Variant.from_text("wide", "{method: mrgs, sed: 1}", "wide.yaml"), tiny_options(), 0
        )


@pytest.mark.parametrize("method", ["mrgs", "thermonerf"])
def test_a_variant_has_the_resolution_of_all(method):
    variant = Variant.from_text("small", f"{{method: {method}, resolution: 20}}", "small.yaml")
    for resolution in (None, 30):
        with pytest.raises(ConfigError, match=r"^small\.yaml .*resolution"):
            configure(variant, tiny_options(resolution=resolution), 0)
    assert configure(variant, tiny_options(resolution=20), 0).resolution == 20


@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt", "thermonerf"])
def test_a_configuration_survives_its_text(method):
    config = configure(Variant(method, method), tiny_options(), 1)
    assert from_text(write_yaml(config)) == config
    with pytest.raises(ConfigError, match=r"request .*method"):
        from_text("3")
