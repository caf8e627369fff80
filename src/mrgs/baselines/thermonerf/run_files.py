"""The config.yaml of a run's folder, for runs of this method; everything else in the folder is as
in any run."""

from __future__ import annotations

from mrgs.baselines.thermonerf.config import ThermoNerfConfig, from_yaml, is_thermonerf, to_yaml
from mrgs.errors import ConfigError, RunError
from mrgs.system.atomic import replacing
from mrgs.training.run_folder import RunFolder


def holds_thermonerf(folder: RunFolder) -> bool:
    """Whether the folder is a run of this method."""
    try:
        return is_thermonerf(folder.config_file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return False


def start(folder: RunFolder, config: ThermoNerfConfig) -> None:
    """Make the folder a new run.

    Raises:
        RunError: the folder holds a run or somebody else's config.yaml, or cannot be written.
    """
    require_new(folder)
    folder.log_file.unlink(missing_ok=True)
    with replacing(folder.config_file) as temporary:
        temporary.write_text(to_yaml(config), encoding="utf-8")


def require_new(folder: RunFolder) -> None:
    """A folder without checkpoints may become a new run: one that died before its first leaves
    nothing to keep.

    Raises:
        RunError: the folder holds a run, or files that are not a run's.
    """
    if folder.checkpoints() or not holds_thermonerf(folder):
        folder.require_new()


def read_config(folder: RunFolder) -> ThermoNerfConfig:
    """The run's configuration.

    Raises:
        RunError: the folder is not a run of this method, or its configuration cannot be used.
    """
    try:
        text = folder.config_file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(
            f"{folder.path} is not a run: its config.yaml cannot be read; name a folder that "
            f"`mrgs train` wrote"
        ) from error
    if not is_thermonerf(text):
        raise RunError(
            f"{folder.path} is not a ThermoNeRF run: resume it with the --method that it was "
            f"trained with"
        )
    try:
        return from_yaml(text, str(folder.config_file))
    except ConfigError as error:
        raise RunError(f"{error}; mend the file or train anew") from error
