"""Time the fused two-opacity pass on the CPU: medians of forward and backward, per number of Gaussians and image size.

    OMP_WAIT_POLICY=PASSIVE python benchmarks/rasterizer.py

The scene is a wall of thin Gaussians with clutter before it, seen by one camera with a field of view of 60°.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from mrgs.rasterizer import Layer, Raster, rasterize

CASES = ((50_000, 320, 240), (50_000, 640, 480), (200_000, 640, 480))


def room(count: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Half the Gaussians on a wall 6 m away, half as clutter before it."""

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    wall = count // 2
    clutter = count - wall
    means = torch.cat(
        [
            torch.stack([uniform(-4, 4, wall), uniform(-3, 3, wall), 6 + 0.05 * normal(wall)], dim=1),
            torch.stack([1.2 * normal(clutter), 0.9 * normal(clutter), uniform(2, 5.5, clutter)], dim=1),
        ]
    )
    return {
        "means": means,
        "quats": normal(count, 4),
        "scales": 6 / count**0.5 * torch.exp(0.5 * normal(count, 3)) * torch.tensor([1.0, 1.0, 0.3]),
        "opacity_rgb": uniform(0.05, 0.95, count),
        "opacity_thermal": uniform(0.05, 0.95, count),
        "colors": torch.rand(count, 3, generator=generator),
        "temperatures": torch.rand(count, 1, generator=generator),
    }


def render(scene: dict[str, torch.Tensor], width: int, height: int) -> Raster:
    """One fused pass."""
    focal = 0.5 * width / 0.57735
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    layers = [
        Layer(scene["opacity_rgb"], scene["colors"], torch.zeros(3)),
        Layer(scene["opacity_thermal"], scene["temperatures"], torch.zeros(1)),
    ]
    return rasterize(scene["means"], scene["quats"], scene["scales"], layers, torch.eye(4), K, width, height)


def measure(count: int, width: int, height: int, runs: int) -> tuple[float, float]:
    """Median milliseconds of the forward and of the backward pass."""
    generator = torch.Generator().manual_seed(0)
    scene = {name: tensor.requires_grad_() for name, tensor in room(count, generator).items()}
    forward, backward = [], []
    for run in range(runs + 2):
        started = time.perf_counter()
        images = [image for blend in render(scene, width, height).blends for image in blend]
        rendered = time.perf_counter()
        torch.autograd.backward(images, [torch.ones_like(image) for image in images])
        done = time.perf_counter()
        if run >= 2:  # the first two compile and warm the caches
            forward.append(1e3 * (rendered - started))
            backward.append(1e3 * (done - rendered))
    return statistics.median(forward), statistics.median(backward)


def main() -> None:
    """Print a markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print("| Gaussians | image | forward, ms | backward, ms | both, ms |\n|---|---|---|---|---|")
    for count, width, height in CASES:
        forward, backward = measure(count, width, height, arguments.runs)
        print(f"| {count:,} | {width}×{height} | {forward:.0f} | {backward:.0f} | {forward + backward:.0f} |")


if __name__ == "__main__":
    main()
