"""The processes of one ``torchrun``, connected: texts and tensors that all of them share.

Small texts and the queue of work go through torchrun's key-value store; tensors through a group of
PyTorch's, over gloo on CPUs and NCCL on GPUs. The store outlives a restart of the processes, so
what they write there carries the name of their round.
"""

from __future__ import annotations

import json
import secrets
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cached_property
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from mrgs.distributed.launch import Launch
from mrgs.errors import ConfigError, LinkError, PeerError

JOIN_S = 600.0
"""How long a process waits for the others to start."""

SILENCE_S = 600.0
"""How long a process waits for another one that says nothing, before it takes the link for lost.
Reading a large scene and compiling the kernels take minutes."""

_POLL_S = 0.02
_HOST = torch.device("cpu")
_FAILED = "failed"


class Processes:
    """The processes of one torchrun, as one of them sees them.

    Every method that shares or gathers must be called by all of them, in the same order.

    Attributes:
        launch: this process's place among them.
        store: torchrun's key-value store, of this round of processes alone.
        device: where tensors are exchanged: a GPU with NCCL, else the CPU.
        stopped: whether all have agreed to stop before the end.
    """

    def __init__(self, launch: Launch, store: dist.Store, join_s: float = JOIN_S) -> None:
        """Meet the others.

        Args:
            launch: this process's place.
            store: that of torchrun.
            join_s: how long to wait for them.

        Raises:
            LinkError: they do not come.
        """
        self.launch = launch
        self.stopped = False
        self._lasting = dist.PrefixStore("mrgs", store)
        try:
            self._round = _meet(self._lasting, launch, join_s)
        except RuntimeError as error:
            raise LinkError(
                f"process {launch.rank} on {socket.gethostname()} cannot reach the others: check "
                f"that all machines run the same torchrun command, and the network between them"
            ) from error
        self.store = dist.PrefixStore(self._round, self._lasting)

    @property
    def rank(self) -> int:
        """The number of this process, from 0."""
        return self.launch.rank

    @property
    def count(self) -> int:
        """How many processes there are."""
        return self.launch.world_size

    @property
    def is_first(self) -> bool:
        """Whether this process writes the files and speaks to the user."""
        return self.launch.is_first

    @property
    def device(self) -> torch.device:
        """Where tensors are exchanged: a GPU with NCCL, else the CPU."""
        if dist.get_backend(self._group) == "nccl":
            return torch.device("cuda", torch.cuda.current_device())
        return _HOST

    @cached_property
    def _group(self) -> dist.ProcessGroup:
        """PyTorch's group, made when the first tensor is exchanged: work that is only taken from
        the queue needs none."""
        with self.linked():
            dist.init_process_group(
                _backend(self.launch),
                store=self.store,
                rank=self.rank,
                world_size=self.count,
                timeout=timedelta(seconds=SILENCE_S),
            )
        group = dist.group.WORLD
        assert group is not None
        return group

    def connect(self) -> None:
        """Connect with the others now, so that each notices at once when another one ends.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        assert self._group is not None

    def remember(self, name: str) -> None:
        """Note something for the processes that torchrun starts after this round."""
        with self.linked():
            self._lasting.set(f"remembered/{name}", "")

    def remembers(self, name: str) -> bool:
        """Whether this round or one before it has noted something."""
        with self.linked():
            return self._lasting.check([f"remembered/{name}"])

    def share_json(self, value: Any = None) -> Any:
        """The first process's value, as JSON keeps it.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        text = _bytes_of(value)
        size = int(self.share_tensor(torch.tensor(len(text))))
        own = text if self.is_first else torch.zeros(size, dtype=torch.uint8)
        return json.loads(bytes(self.share_tensor(own).numpy()))

    def gather_json(self, value: Any) -> list[Any]:
        """The values of all processes, by their numbers.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        text = _bytes_of(value)
        sizes = [int(size) for size in self.gather_tensors(torch.tensor([len(text)]))]
        padded = torch.zeros(max(sizes), dtype=torch.uint8)
        padded[: len(text)] = text
        gathered = self.gather_tensors(padded)
        return [
            json.loads(bytes(each[:size].numpy()))
            for each, size in zip(gathered, sizes, strict=True)
        ]

    def share_tensor(self, tensor: Tensor) -> Tensor:
        """The first process's tensor, on the host.

        Args:
            tensor: of the same type and shape on all processes.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        shared = tensor.detach().to(self.device).contiguous().clone()
        with self.linked():
            dist.broadcast(shared, 0, group=self._group)
        return shared.to(_HOST)

    def share_tensors(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The first process's tensors by name, on the host; those of the others do not matter.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        described = {
            name: [str(tensor.dtype).removeprefix("torch."), list(tensor.shape)]
            for name, tensor in tensors.items()
        }
        shared = {}
        for name, (dtype, shape) in self.share_json(described).items():
            own = (
                tensors[name] if self.is_first else torch.empty(shape, dtype=getattr(torch, dtype))
            )
            shared[name] = self.share_tensor(own)
        return shared

    def gather_tensors(self, tensor: Tensor) -> list[Tensor]:
        """The tensors of all processes, by their numbers, on the host.

        Args:
            tensor: of the same type and shape on all processes.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        return list(self.all_gather(tensor.detach().to(self.device)).to(_HOST))

    def all_gather(self, tensor: Tensor) -> Tensor:
        """The tensors of all processes, stacked, where they are exchanged.

        Args:
            tensor: on ``device``; of the same type and shape on all processes.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        gathered = tensor.new_empty((self.count, *tensor.shape))
        with self.linked():
            dist.all_gather(list(gathered), tensor.contiguous(), group=self._group)
        return gathered

    def all_to_all(self, rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
        """Rows for each process, for those from each process.

        Args:
            rows: on ``device``; those for the first process come first.
            sent: how many are for each.
            received: how many come from each.

        Raises:
            LinkError, PeerError: another process is gone.
        """
        result = rows.new_empty((sum(received), *rows.shape[1:]))
        with self.linked():
            dist.all_to_all_single(result, rows.contiguous(), received, sent, group=self._group)
        return result

    def raise_first(self, problem: str | None, kind: type[Exception]) -> None:
        """Stop all processes with one message if any of them has a problem.

        Args:
            problem: of this process; None if it has none.
            kind: of the error; the message is its argument.

        Raises:
            kind: on the first process.
            PeerError: on the others.
            LinkError: another process is gone.
        """
        problems = [each for each in self.gather_json(problem) if each is not None]
        if not problems:
            return
        if self.is_first:
            raise kind(problems[0])
        raise PeerError("the first process says why")

    def claim_failure(self) -> bool:
        """Whether this process is the first to fail, and so the one that says why.

        Without the store nobody knows, so each says it.
        """
        with suppress(RuntimeError):
            return self.store.compare_set(_FAILED, "", str(self.rank)) == str(self.rank).encode()
        return True

    @contextmanager
    def linked(self) -> Iterator[None]:
        """Turn what PyTorch says of a lost link into the error of the process that lost it."""
        try:
            yield
        except RuntimeError as error:
            if not self.claim_failure():
                raise PeerError("another process says why") from error
            raise LinkError(
                f"process {self.rank} of {self.count} on {socket.gethostname()} has lost the "
                f"others: one of them has ended, or the network between them is down; start again "
                f"to go on from the last checkpoint"
            ) from error

    def leave(self) -> None:
        """Part from the others."""
        if vars(self).pop("_group", None) is not None:  # its threads must end before Python does
            with suppress(RuntimeError):
                dist.destroy_process_group()


@contextmanager
def joined(launch: Launch) -> Iterator[Processes]:
    """Within this block, this process is connected with the others.

    Of errors that several processes have at the same time, one stays what it is.

    Raises:
        ConfigError: this PyTorch has no torch.distributed.
        LinkError: the others cannot be reached.
        PeerError: another process has failed, and says why.
    """
    if not dist.is_available():
        raise ConfigError(
            "this PyTorch has no torch.distributed: install one that has, or one process"
        )
    try:
        store = next(dist.rendezvous("env://", timeout=timedelta(seconds=JOIN_S)))[0]
    except (RuntimeError, ValueError) as error:
        raise LinkError(
            f"process {launch.rank} on {socket.gethostname()} cannot reach torchrun's store: check "
            f"the address of the first machine, and the network to it"
        ) from error
    processes = Processes(launch, store)
    try:
        if torch.cuda.is_available():
            torch.cuda.set_device(launch.gpu(torch.cuda.device_count()))
        yield processes
    except (LinkError, PeerError):
        raise
    except Exception as error:
        if not processes.claim_failure():
            raise PeerError("another process says why") from error
        raise
    finally:
        processes.leave()


def _bytes_of(value: Any) -> Tensor:
    """A value's JSON as bytes."""
    return torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)


def _backend(launch: Launch) -> str:
    """NCCL where each process of this machine has a GPU of its own, else gloo."""
    has_gpus = torch.cuda.is_available() and torch.cuda.device_count() >= launch.local_world_size
    return "nccl" if has_gpus and dist.is_nccl_available() else "gloo"


def _meet(store: dist.Store, launch: Launch, join_s: float) -> str:
    """The name of this round of processes.

    torchrun's count of restarts differs between machines, and what earlier processes wrote is still
    in the store. So each process asks under a name of its own, and the first one answers all.

    Raises:
        RuntimeError: the others do not come, or the store is gone.
    """
    own = secrets.token_hex(8)
    if not launch.is_first:
        store.set(f"asks/{launch.rank}", own)
        store.wait([f"answer/{own}"], timedelta(seconds=join_s))
        name = store.get(f"answer/{own}").decode()
        store.set(f"{name}/arrived/{launch.rank}", "")
        return name
    missing = set(range(1, launch.world_size))
    end = time.monotonic() + join_s
    while missing:
        if time.monotonic() > end:
            raise RuntimeError(f"processes {sorted(missing)} have not come")
        for rank in list(missing):
            if store.check([f"asks/{rank}"]):
                store.set(f"answer/{store.get(f'asks/{rank}').decode()}", own)
            if store.check([f"{own}/arrived/{rank}"]):
                missing.discard(rank)
        time.sleep(_POLL_S)
    return own
