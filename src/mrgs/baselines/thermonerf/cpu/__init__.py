"""Numba kernels of the radiance field, each with its analytic gradient; their bits do not depend on
the threads."""

from mrgs.baselines.thermonerf.cpu.hash_grid import CHANNELS, encode
from mrgs.baselines.thermonerf.cpu.perceptron import perceptron

__all__ = ["CHANNELS", "encode", "perceptron"]
