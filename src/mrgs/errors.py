"""What a user can be told. Every message names the file or value at fault and says what to do."""

from __future__ import annotations


class MrgsError(Exception):
    """An error that the user can mend; the command line prints it as one line and exits with code
    2."""


class SceneError(MrgsError):
    """A scene folder, or a file in it, cannot be used."""


class RunError(MrgsError):
    """A run folder, or a checkpoint in it, cannot be used."""


class ConfigError(MrgsError):
    """An option or a configuration value is not allowed."""


class DeviceError(MrgsError):
    """The GPU that was asked for cannot be used."""


class TrainingError(MrgsError):
    """Training had to stop; the last good checkpoint is kept."""


class MrgsWarning(UserWarning):
    """Something was mended or left out; the result is usable, and the message says what changed."""
