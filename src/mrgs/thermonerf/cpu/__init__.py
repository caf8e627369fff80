"""Numba kernels of the radiance field, each with its analytic gradient; their bits do not depend on the threads."""

from mrgs.thermonerf.cpu.hash_grid import CHANNELS, encode
from mrgs.thermonerf.cpu.perceptron import perceptron

__all__ = ["CHANNELS", "encode", "perceptron"]
