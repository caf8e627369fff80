"""Poses from the images alone: structure from motion with pycolmap.

``reconstruct`` sets up a working folder with ``job.json`` and the images that it names, and starts
``python -m mrgs.prepare.sfm FOLDER``. Only that process imports pycolmap, and it imports nothing
that needs torch. Its results are ``database.db`` (features and matches in COLMAP's format) and
``model``: COLMAP's binary files, ``points.npz`` and ``report.json``. Existing results are kept; the
database grows by transactions, and the model is moved to its place when it is complete.

The process writes a JSON object per line to its standard output: ``{"step", "done", "of"}``, and
last ``{"end"}``: "done", or "error" with "message". It ends when its standard input is closed, as
when its parent dies.
"""
