"""Which compiled functions Python can call."""

from __future__ import annotations

import pytest
from numba.extending import is_jitted

from mrgs.kernels.blur import cpu


@pytest.mark.skipif(not is_jitted(cpu._add_rows), reason="nothing is compiled")
def test_an_inner_function_is_called_by_kernels_alone():
    with pytest.raises(TypeError, match="_add_rows"):
        cpu._add_rows()
