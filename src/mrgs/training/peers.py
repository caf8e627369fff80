"""What the processes of a training agree on before its first step: configuration, scene, state.

The first process reads and writes the run's folder; the others need not even see it.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from mrgs.distributed.processes import Processes
from mrgs.errors import ConfigError, RunError
from mrgs.method.config import TrainConfig
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.scene import Scene
from mrgs.system.strict_yaml import first_difference, flat, parse_yaml, write_yaml
from mrgs.training import checkpoint
from mrgs.training.facts import CheckpointFacts, differences
from mrgs.training.run_folder import RunConfig, RunFolder
from mrgs.training.state import TrainingState

_BEGUN = "begun"


class FollowedRun(RunFolder):
    """A run's folder as a process sees it that writes nothing: its configuration is the first
    process's.

    Args:
        path: the folder, which need not be there.
        config_text: the configuration, as YAML.
    """

    def __init__(self, path: str | Path, config_text: str) -> None:
        super().__init__(path)
        self._shared_text = config_text

    def _config_text(self) -> str:
        return self._shared_text

    def append_log(self, entry: dict[str, Any]) -> None:
        """Nothing."""

    def cut_log(self, step: int) -> None:
        """Nothing."""

    def drop_old_checkpoints(self) -> None:
        """Nothing."""

    @contextmanager
    def training(self, config: RunConfig, resume: bool) -> Iterator[None]:
        """Hold nothing: the first process does."""
        yield


class Peers:
    """The processes of a training, before its first step.

    Args:
        processes: all of them, connected.
        device: where this one trains.
        strategy: density control, if the run was given one.
        terms: of the loss, if the run was given any.
    """

    def __init__(
        self,
        processes: Processes,
        device: torch.device,
        strategy: Strategy | None,
        terms: Sequence[Term],
    ) -> None:
        self.processes = processes
        self._device = device
        self._strategy = strategy
        self._terms = terms

    @property
    def lead(self) -> bool:
        """Whether this process is the first one."""
        return self.processes.is_first

    def were_restarted(self, folder: RunFolder) -> bool:
        """Whether torchrun has restarted the processes of a run that has come to a checkpoint."""
        return self.processes.remembers(_BEGUN) and bool(folder.checkpoints())

    def agree(self, folder: RunFolder, config: TrainConfig, resume: bool) -> tuple[RunFolder, bool]:
        """All processes take the first one's configuration.

        Args:
            folder: of the run.
            config: of this process; of the first one: the one in force.
            resume: whether the first process continues the run.

        Returns:
            the run's folder as this process may use it, and whether the run is continued.

        Raises:
            RunError: the processes are of different versions, or were started differently.
            ConfigError: there are more of them than views in a step.
        """
        own = version("mrgs")
        first, text, resume = self.processes.share_json([own, write_yaml(config), resume])
        problem = _other_version(self.processes, own, first)
        if not resume:
            problem = problem or _other_configuration(self.processes, text, config)
        self.processes.raise_first(problem, RunError)
        if self.lead:
            self._require_enough_views(config)
            return folder, resume
        return FollowedRun(folder.path, text), resume

    def _require_enough_views(self, config: TrainConfig) -> None:
        if config.batch < self.processes.count:
            raise ConfigError(
                f"each step of this run has a batch of {config.batch} views, which is not enough "
                f"for {self.processes.count} processes: start at most {config.batch}"
            )

    def share(self, state: TrainingState, facts: CheckpointFacts) -> None:
        """Give the state to the others, once they have the same scene; the first process does this.

        Raises:
            RunError: one of the others sees another scene.
        """
        header = checkpoint.header_of(state, facts)
        self.processes.share_json(header)
        self.processes.raise_first(None, RunError)
        self.processes.share_tensors(checkpoint.tensors_of(state))
        self.processes.remember(_BEGUN)

    def receive(self, scene: Scene, config: TrainConfig) -> tuple[TrainingState, CheckpointFacts]:
        """The first process's state, and the facts of its run.

        Raises:
            PeerError: this process sees another scene, or another one does.
            MrgsError: a photo cannot be read.
        """
        header = self.processes.share_json()
        facts = CheckpointFacts.from_json(header)
        self.processes.raise_first(_other_scene(self.processes, facts, scene), RunError)
        tensors = self.processes.share_tensors({})
        path = Path("the state of the first process")
        state = checkpoint.state_of(
            tensors, facts, header, path, config, self._device, self._strategy, self._terms
        )
        return state, facts


def require_alike(processes: Processes, config: TrainConfig, scene: Scene) -> None:
    """Stop processes that do parts of one work if they would do different ones.

    Raises:
        RunError: on the first process: another one is of another version, was started differently,
            or sees another scene.
        PeerError: the same, on the others.
        SceneError: a photo cannot be read.
    """
    require_same_version(processes)
    seen = CheckpointFacts.at_start(scene).to_json() if processes.is_first else None
    text, header = processes.share_json([write_yaml(config), seen])
    problem = _other_configuration(processes, text, config)
    if problem is None:
        problem = _other_scene(processes, CheckpointFacts.from_json(header), scene)
    processes.raise_first(problem, RunError)


def require_same_version(processes: Processes) -> None:
    """Stop processes that share out work if they are of different versions of the program.

    Raises:
        RunError: on the first process: another one is of another version.
        PeerError: the same, on the others.
    """
    own = version("mrgs")
    processes.raise_first(_other_version(processes, own, processes.share_json(own)), RunError)


def _other_version(processes: Processes, own: str, first: str) -> str | None:
    if first == own:
        return None
    return f"{_name_of(processes)} is mrgs {own}, the first one is {first}: install one version"


def _other_configuration(processes: Processes, text: str, config: TrainConfig) -> str | None:
    """What is wrong if this process differs from the first one in a value."""
    theirs, ours = (flat(parse_yaml(each, "")) for each in (text, write_yaml(config)))
    name = first_difference(theirs, ours)
    if name is None:
        return None
    return (
        f"{_name_of(processes)} was started with another configuration than the first one "
        f"({name}: {ours.get(name)}, not {theirs.get(name)}): run the same command everywhere"
    )


def _other_scene(processes: Processes, facts: CheckpointFacts, scene: Scene) -> str | None:
    other = differences(facts, scene)
    if not other:
        return None
    return (
        f"{_name_of(processes)} sees another scene than the first one ({other}): give all the same "
        f"files"
    )


def _name_of(processes: Processes) -> str:
    return f"process {processes.rank} on {socket.gethostname()}"
