from __future__ import annotations

import pytest
import torch

from mrgs.scene import RGB, THERMAL, Gaussians
from tests.helpers.gaussians import NEAR_INFRARED, random_gaussians

NAMES = [
    "means", "quats", "log_scales", "opacity_logit.rgb", "opacity_logit.thermal",
    "sh_dc.rgb", "sh_dc.thermal", "sh_rest.rgb", "sh_rest.thermal", "embedding",
]  # fmt: skip


def make(shares_opacity: bool = False) -> Gaussians:
    return random_gaussians(7, shares_opacity, embedding_width=24)


def test_scales_and_opacities_are_read_through_their_logarithms():
    gaussians = make()
    assert len(gaussians) == 7
    torch.testing.assert_close(gaussians.scales.log(), gaussians.log_scales)
    for modality in (RGB, THERMAL):
        logits = gaussians.opacity_logits[modality][:, 0]
        torch.testing.assert_close(gaussians.opacity(modality).logit(), logits)
    assert not torch.equal(gaussians.opacity(RGB), gaussians.opacity(THERMAL))


def test_a_modality_without_an_opacity_shares_that_of_the_first():
    gaussians = make(shares_opacity=True)
    assert torch.equal(gaussians.opacity(THERMAL), gaussians.opacity(RGB))
    assert "opacity_logit.thermal" not in gaussians.tensors()


def test_modalities_with_higher_degrees_depend_on_the_view(near_infrared):
    gaussians = random_gaussians(3, modalities=(RGB, THERMAL, near_infrared))
    assert gaussians.modalities == (RGB, THERMAL, near_infrared)
    depends = [gaussians.depends_on_view(modality) for modality in gaussians.modalities]
    assert depends == [True, False, True]


def test_tensors_are_the_parameters_themselves_by_name():
    gaussians = make()
    tensors = gaussians.tensors()
    assert list(tensors) == NAMES
    assert tensors["means"] is gaussians.means
    assert tensors["sh_dc.thermal"] is gaussians.sh_dc[THERMAL]
    assert tensors["opacity_logit.rgb"] is gaussians.opacity_logits[RGB]


@pytest.mark.parametrize("shares_opacity", [True, False])
def test_gaussians_come_back_from_their_tensors(shares_opacity, near_infrared):
    gaussians = random_gaussians(4, shares_opacity, modalities=(RGB, THERMAL, near_infrared))
    tensors = gaussians.tensors()
    found = Gaussians.from_tensors(tensors)
    assert found.modalities == gaussians.modalities
    assert list(found.tensors()) == list(tensors)
    assert all(tensor is tensors[name] for name, tensor in found.tensors().items())


def test_modalities_need_not_be_known_where_they_are_given():
    modalities = (NEAR_INFRARED, RGB)
    tensors = random_gaussians(4, modalities=(RGB, NEAR_INFRARED)).tensors()
    found = Gaussians.from_tensors(tensors, modalities)
    assert found.modalities == modalities  # in the order that is asked for
    assert all(tensor is tensors[name] for name, tensor in found.tensors().items())
    assert found.with_tensors(tensors).modalities == modalities
    with pytest.raises(ValueError, match="unknown modalities: nir"):
        Gaussians.from_tensors(tensors)
    with pytest.raises(ValueError, match="unknown modalities: rgb"):
        Gaussians.from_tensors(tensors, [NEAR_INFRARED])


def test_a_missing_tensor_is_named():
    tensors = make().tensors()
    del tensors["quats"]
    with pytest.raises(KeyError, match="quats"):
        Gaussians.from_tensors(tensors)


@pytest.mark.parametrize("name", NAMES)
def test_a_tensor_is_replaced_by_its_name(name):
    gaussians = make()
    before = gaussians.tensors()
    new = torch.zeros_like(before[name])
    gaussians.replace(name, new)
    after = gaussians.tensors()
    assert list(after) == NAMES
    assert after[name] is new
    assert all(after[other] is before[other] for other in NAMES if other != name)


@pytest.mark.parametrize("name", ["scales", "opacity_logit", "sh_dc.nir", "means.rgb"])
def test_what_is_no_tensor_is_not_replaced(name):
    with pytest.raises(KeyError, match=name):
        make().replace(name, torch.zeros(7, 1, 1))


def test_copies_on_a_device_have_no_gradient():
    gaussians = make()
    for tensor in gaussians.tensors().values():
        tensor.requires_grad_()
    copies = gaussians.to(torch.device("cpu"))
    assert list(copies.tensors()) == NAMES
    for name, tensor in copies.tensors().items():
        assert torch.equal(tensor, gaussians.tensors()[name])
        assert not tensor.requires_grad
