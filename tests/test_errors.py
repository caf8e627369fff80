from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from mrgs import errors

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
