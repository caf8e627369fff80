from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from benchmarks.plan import GAUSSIANS, GROUPS, QUICK, SIZES, Case

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("group", "count"),
    [
        ("rasterizer", len(GAUSSIANS) * len(SIZES)),
        ("losses", len(SIZES)),
        ("heads", len(GAUSSIANS)),
        ("prototype", 3),
    ],
)
def test_a_group_is_measured_once_at_each_size_it_depends_on(group, count):
    cases = GROUPS[group].cases()
    assert len(cases) == len(set(cases)) == count


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_quick_takes_some_of_the_cases(group):
    quick = group.cases(quick=True)
    assert 0 < len(quick) <= len(QUICK)
    assert set(quick) <= set(group.cases())


def test_cases_survive_the_way_to_the_child():
    case = GROUPS["losses"].cases()[0]
    assert Case(**json.loads(json.dumps(asdict(case)))) == case
    assert case.gaussians is None
    with pytest.raises(ValueError, match="losses"):
        _ = case.size


def test_the_parent_process_loads_no_torch():
    script = "import sys, benchmarks.__main__; print(*{'torch', 'numba'} & set(sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == []
