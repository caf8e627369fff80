"""Devices, atomic files, child processes, and operations that kernels may compute."""
