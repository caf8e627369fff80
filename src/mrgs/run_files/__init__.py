"""The files of a run of any method: its folder with configuration and log, its checkpoints, and
what identifies the scene that it was trained on."""
