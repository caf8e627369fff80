"""The losses' Numba kernels, each compiled on first call for float32 or float64 and kept on disk.

A file calls no kernel of another file: Numba keeps a compiled kernel until its own file changes.
Sums are made per strip of rows or per row, and then in order, so that they have the same bits
whatever the number of threads.
"""
