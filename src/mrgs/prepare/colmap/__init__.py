"""Structure from motion with pycolmap, in a process of its own: ``python -m mrgs.prepare.colmap
FOLDER``.

Only this package imports pycolmap, and it imports nothing that needs torch; ``mrgs.prepare.sfm``
starts it. FOLDER holds ``job.json`` and the images that it names. The
results are ``database.db``, with features and matches in COLMAP's format, and ``model``: COLMAP's
binary files, ``points.npz`` and ``report.json``. Existing results are kept; the database grows by
transactions, and the model is moved to its place when it is complete.

The process writes a JSON object per line to its standard output: ``{"step", "done", "of"}``, and
last ``{"end"}``: "done", or "error" with "message". It ends when its standard input is closed, as
when its parent dies.
"""
