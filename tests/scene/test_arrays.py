from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.scene.arrays import as_finite, as_floats, as_tensor, as_whole, constant

NUMBERS = np.arange(6.0).reshape(2, 3)


@pytest.mark.parametrize(
    "array",
    [
        NUMBERS.astype(">f4"),
        NUMBERS.astype(">u2"),
        NUMBERS.astype(np.longdouble),
        NUMBERS.astype(np.float16),
        *(NUMBERS.astype(f"u{size}") for size in (1, 2, 4, 8)),
        torch.from_numpy(NUMBERS).to(torch.uint16),
        np.asfortranarray(NUMBERS),
        NUMBERS[::-1, ::-1].copy()[::-1, ::-1],
        [torch.arange(3.0, requires_grad=True), (3, 4, torch.tensor(5.0, requires_grad=True))],
    ],
    ids=str,
)
def test_every_array_of_numbers_can_be_computed_with(array):
    found = as_tensor(array, None, (None, 3), "points")
    assert (found + 1).amax(dim=0).tolist() == (NUMBERS[: len(found)] + 1).max(axis=0).tolist()


def test_a_reversed_array_of_one_row_is_taken():
    assert as_tensor(NUMBERS[:1][::-1], None, (1, 3), "points").tolist() == [[0, 1, 2]]


def test_memory_is_shared_where_it_can_be():
    array = NUMBERS.copy()
    found = as_tensor(array, torch.float64, (2, 3), "points")
    array[0, 0] = 7
    assert found[0, 0] == 7


@pytest.mark.parametrize("dtype", [np.float32, ">f8", np.int64, np.uint8])
def test_masked_numbers_are_nan(dtype):
    found = as_tensor(np.ma.masked_greater(NUMBERS.astype(dtype), 4), None, (2, 3), "celsius")
    assert found.isnan().tolist() == [[False] * 3, [False, False, True]]
    assert found[0].tolist() == [0, 1, 2]


def test_an_empty_list_has_no_rows():
    assert as_tensor([], torch.float32, (None, 3), "points").shape == (0, 3)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (NUMBERS + 1j, "^points .*complex"),
        (torch.ones(2, 3) * 1j, "^points .*complex"),
        ([[1, 2, 3], [4]], "^points .*one length"),
        ([["a", "b", "c"]], "^points .*of numbers"),
        (None, "^points .*of numbers"),
        ((row for row in NUMBERS), "^points .*of numbers"),
        ([], r"^points .*\[2, 3\], not \[0\]"),
    ],
)
def test_what_is_no_array_of_numbers(array, message):
    with pytest.raises(ValueError, match=message):
        as_tensor(array, None, (2, 3), "points")


def test_floats_stay_as_they_are_and_integers_become_float64():
    single = torch.ones(2, requires_grad=True)
    assert as_floats(single, "depth") is single
    assert as_floats(np.ones(2, np.float32), "depth").dtype == torch.float32
    assert as_floats(torch.tensor([1, 2]), "depth").dtype == torch.float64
    assert as_floats(2, "depth").tolist() == 2.0


def test_finite_numbers_and_whole_numbers():
    assert as_finite([1, 2], (2,), "target").dtype == torch.float64
    assert as_whole(np.int32(3), "width") == 3
    with pytest.raises(ValueError, match="target holds NaN"):
        as_finite([1, np.nan], (2,), "target")
    with pytest.raises(ValueError, match=r"^width .*3\.0"):
        as_whole(3.0, "width")


def test_a_constant_is_made_once_for_each_type_and_device():
    values = ((1.0, 2.0), (0.1, float("inf")))
    like = torch.zeros(1)
    found = constant(values, like)
    assert found.tolist() == torch.tensor(values).tolist()
    assert constant(values, torch.ones(3)) is found
    assert constant(values, like.double()).dtype == torch.float64
    assert constant(values, torch.zeros(1, device="meta")).device.type == "meta"
