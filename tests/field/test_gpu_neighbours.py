"""The neighbours' Triton kernel against a full search, and the field on a device that the host must
not wait for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.scene import Gaussians
from mrgs.system import gpu
from mrgs.system.cuda_graph import sync_debug_mode


def full_search(means: torch.Tensor, k: int) -> torch.Tensor:
    """All squared distances sorted, of equal ones the lower index first, then the point itself."""
    count = len(means)
    squares = (means[:, None].double() - means.double()).square()
    distances = (squares[..., 0] + squares[..., 1] + squares[..., 2]).fill_diagonal_(torch.inf)
    found = max(min(k, count - 1), 0)
    padding = torch.arange(count)[:, None].expand(count, k - found)
    return torch.cat([distances.sort(dim=1, stable=True).indices[:, :found], padding], dim=1)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of eight points and chunks of two boxes, so that few points fill many."""
    pytest.importorskip("triton")
    from mrgs.kernels.neighbours import gpu as neighbours

    monkeypatch.setattr(neighbours, "BLOCK", 8)
    monkeypatch.setattr(neighbours, "CHUNK", 2)


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    count=st.integers(0, 28),
    k=st.sampled_from([0, 1, 3, 8, 15, 16]),
    seed=st.integers(0, 2**31),
    kind=st.sampled_from(["apart", "lattice", "one place"]),
)
def test_neighbours_are_those_of_a_full_search(gpu_device, small_blocks, count, k, seed, kind):
    generator = torch.Generator().manual_seed(seed)
    means = torch.randint(
        0, 3 if kind == "lattice" else 1000, (count, 3), generator=generator
    ).float()
    if kind == "one place":
        means = means[:1].expand(count, 3)
    found = nearest_neighbours(means.to(gpu_device), k)
    assert found.dtype == torch.int64
    assert found.device.type == gpu_device
    assert torch.equal(found.cpu(), full_search(means, k))


def test_a_kd_tree_finds_the_same(gpu_device):
    means = torch.randn(150, 3, generator=torch.Generator().manual_seed(0))
    means[:5] *= 1e4  # far outside
    expected = torch.from_numpy(
        cKDTree(means.double().numpy()).query(means.double().numpy(), k=5)[1][:, 1:]
    )
    assert torch.equal(nearest_neighbours(means.to(gpu_device), 4).cpu(), expected)


def test_a_position_that_is_not_finite_is_nobodys_neighbour(gpu_device):
    means = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    means[7, 1], means[11, 0] = float("nan"), -float("inf")
    found = nearest_neighbours(means.to(gpu_device), 4).cpu()
    finite = [i for i in range(20) if i not in (7, 11)]
    assert not {7, 11} & set(found[finite].flatten().tolist())


def test_more_neighbours_than_the_kernel_takes_are_found_on_the_host(gpu_device):
    means = torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(nearest_neighbours(means.to(gpu_device), 24).cpu(), full_search(means, 24))


class NoKernel:
    """Stands for a kernel where there is nothing to compute."""

    arg_names = ()

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        return lambda *args, **kwargs: None


@pytest.mark.slow
def test_the_search_does_not_make_the_host_wait(monkeypatch):
    pytest.importorskip("triton")
    from mrgs.kernels.neighbours import gpu as neighbours

    monkeypatch.setattr(gpu, "runs_triton", lambda tensor: True)
    monkeypatch.setattr(neighbours, "neighbours_kernel", NoKernel())
    assert nearest_neighbours(torch.empty(100, 3, device="meta"), 8).shape == (100, 8)


@pytest.mark.parametrize(
    "config", [FieldConfig(), FieldConfig(fourier=False), FieldConfig(residuals=False)]
)
@pytest.mark.parametrize("bands", [0, 15])
@pytest.mark.parametrize("picks", [False, True])
def test_the_field_does_not_make_the_host_wait(config, bands, picks):
    """Tensors without values: what asks for one fails, as on a GPU it would make the host wait."""
    count = 50
    shapes = {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "opacity_logit.rgb": (1,),
        "opacity_logit.thermal": (1,),
        "sh_dc.rgb": (1, 3),
        "sh_rest.rgb": (15, 3),
        "sh_dc.thermal": (1, 1),
        "sh_rest.thermal": (bands, 1),
        "embedding": (config.embedding_width if config.residuals else 0,),
    }
    tensors = {
        name: torch.empty(count, *shape, device="meta").requires_grad_()
        for name, shape in shapes.items()
    }
    gaussians, field = Gaussians.from_tensors(tensors), RadianceField(config).to("meta")
    neighbours = torch.empty(count, config.neighbours_k, dtype=torch.int64, device="meta")
    rows = torch.empty(20, dtype=torch.int64, device="meta") if picks else None
    position = torch.empty(3, device="meta")
    colors = field.colors(gaussians, position, 3, rows)
    temperatures = field.temperatures(gaussians, neighbours, position, 3, rows)
    assert len(colors) == len(temperatures) == (20 if picks else count)
    (colors.sum() + temperatures.sum()).backward()
    assert all(parameter.grad is not None for parameter in field.parameters())


@pytest.mark.gpu
def test_many_points_and_no_round_trip():
    means = torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0))
    on_device = means.to("cuda")
    with sync_debug_mode("error"):
        found = nearest_neighbours(on_device, 8)
    expected = torch.from_numpy(
        cKDTree(means.double().numpy()).query(means.double().numpy(), k=9)[0][:, 1:]
    )
    distances = (means.double()[found.cpu()] - means.double()[:, None]).norm(dim=2)
    torch.testing.assert_close(distances, expected, rtol=1e-6, atol=0)
