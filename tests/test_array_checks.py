"""The checks of tests/helpers/array_checks.py are at work, where there is an array."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch
from jaxtyping import Bool, Float, TypeCheckError
from torch import Tensor

from mrgs.data.images import of_eight_bit_levels
from mrgs.scene import RGB, Gaussians
from mrgs.training.photos import bytes_per_pixel
from tests.helpers.array_checks import has_arrays

pytestmark = pytest.mark.skipif(
    not os.environ.get("CHECK_ARRAYS"), reason="only where CHECK_ARRAYS is set"
)

Reader = Callable[[str], Float[Tensor, "h w"]]


def test_arguments_and_results_of_another_shape_or_type_are_found():
    with pytest.raises(TypeCheckError, match="levels"):
        of_eight_bit_levels(torch.zeros(2, 3))
    with pytest.raises(TypeCheckError, match="quats"):
        Gaussians(
            torch.zeros(3, 3), torch.zeros(2, 4), torch.zeros(3, 3), {}, {}, {}, torch.zeros(3, 0)
        )


def test_functions_without_arrays_are_as_they_were():
    assert not hasattr(bytes_per_pixel, "__wrapped__")
    assert hasattr(of_eight_bit_levels, "__wrapped__")
    assert bytes_per_pixel(RGB) == 3


def test_arrays_are_found_in_every_annotation():
    def argument(a: int, b: Float[Tensor, "n"]) -> int: ...
    def result() -> dict[str, Bool[Tensor, "n"]]: ...
    def optional(a: Float[Tensor, "n"] | None = None) -> None: ...
    def alias(read: Reader | None) -> None: ...
    def neither(Float: int, names: list[str]) -> str: ...

    assert all(map(has_arrays, (argument, result, optional, alias)))
    assert not has_arrays(neither)
