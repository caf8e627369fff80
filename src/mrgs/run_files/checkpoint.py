"""The file of a checkpoint of any method: tensors in safetensors, a header of JSON with their
digest, and a digest of the header: a bit that changed anywhere is noticed when the file is read."""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor

from mrgs.errors import DamagedCheckpointError, NotFiniteError, RunError
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import step_named
from mrgs.system.atomic import replacing

FORMAT = 7

_HEADER = "mrgs"
_HEADER_DIGEST = "sha256"
_TENSORS_DIGEST = "tensors_sha256"

MOST_MAPPED_BYTES = 2**24
"""Read from a file before it is closed, until when its pages count as the process's memory."""


def write_file(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write a checkpoint in one file that is either whole or not there. Its header has the JSON
    values of ``CheckpointFacts.to_json``, ``skipped_in_a_row``, and others of the method.
    NotFiniteError if a tensor has a NaN or an infinity, and nothing is written; RunError if the
    file cannot be written."""
    if (name := first_not_finite(tensors)) is not None:
        raise NotFiniteError(f"{name} holds values that are not finite: {path.name} is not written")
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    digest = hashlib.sha256()
    for name in sorted(kept):
        _add_to(digest, name, kept[name])
    text = json.dumps({**header, "format": FORMAT, _TENSORS_DIGEST: digest.hexdigest()})
    metadata = {_HEADER: text, _HEADER_DIGEST: hashlib.sha256(text.encode()).hexdigest()}
    with replacing(path) as temporary:
        safetensors.torch.save_file(kept, temporary, metadata)


def read(
    path: Path, needed: Callable[[str], bool] = lambda name: True
) -> tuple[dict[str, Tensor], CheckpointFacts, dict[str, Any]]:
    """The needed tensors by name, the facts, and the header; all tensors are checked, one by one.
    DamagedCheckpointError if it is not a checkpoint, not what was written, or not finite; RunError
    if the file cannot be read, or has another format."""
    header, names = _header_and_names(path)
    digest = hashlib.sha256()
    tensors: dict[str, Tensor] = {}
    broken = None
    for name, tensor in _tensors_of(path, names):
        _add_to(digest, name, tensor)
        broken = broken or first_not_finite({name: tensor})
        if needed(name):
            tensors[name] = tensor
    if header.get(_TENSORS_DIGEST) != digest.hexdigest():
        raise DamagedCheckpointError(path, "its tensors do not match their digest")
    if broken is not None:
        raise DamagedCheckpointError(path, f"{broken} holds values that are not finite")
    return tensors, _facts(path, header), header


def load_facts(path: Path) -> CheckpointFacts:
    """The facts of a checkpoint, whose tensors are neither read nor checked. DamagedCheckpointError
    if it is not a checkpoint, or has another header than was written; RunError if it cannot be
    read, or has another format."""
    return _facts(path, _header_and_names(path)[0])


def _tensors_of(path: Path, names: Iterable[str]) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a checkpoint, by name, in ascending order."""
    waiting = sorted(names, reverse=True)
    while waiting:
        loaded, left = dict[str, Tensor](), MOST_MAPPED_BYTES
        with _opened(path) as file:
            while waiting and left > 0:
                name = waiting.pop()
                # In memory of its own: if someone cuts off a mapped file, the process ends.
                loaded[name] = file.get_tensor(name).clone()
                left -= loaded[name].nbytes
        yield from loaded.items()


def _facts(path: Path, header: Mapping[str, Any]) -> CheckpointFacts:
    """A header's facts; a file copied under another step's name would hide newer ones."""
    try:
        facts = CheckpointFacts.from_json(header)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedCheckpointError(path, "its header lacks facts") from error
    if step_named(path) not in (None, facts.step):
        raise DamagedCheckpointError(path, f"it is the one of step {facts.step}")
    return facts


def skipped_in_a_row_of(header: Mapping[str, Any]) -> int:
    """Steps skipped since the last good one. KeyError or ValueError if the header lacks it."""
    count = header["skipped_in_a_row"]
    if type(count) is not int or count < 0:
        raise ValueError("skipped_in_a_row is a number of at least 0")
    return count


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Around the use of a checkpoint's tensors. RunError if they do not fit the configuration."""
    try:
        yield
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise RunError(
            f"{path} does not fit the run's config.yaml ({reason:.120}): restore the configuration "
            f"it was trained with"
        ) from error


def require_like(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Check names, types and shapes of tensors from a file, which kernels and optimizers rely on,
    by examples. ValueError if they differ, which names the first tensor that does."""
    for name in sorted(found.keys() | expected.keys()):
        if name not in found:
            raise ValueError(f"{name} is missing")
        if name not in expected:
            raise ValueError(f"{name} is unknown")
        has, needs = (
            f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
            for tensor in (found[name], expected[name])
        )
        if has != needs:
            raise ValueError(f"{name} is {has} where {needs} is expected")


def below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, by the rest of their names."""
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of a tensor with a NaN or an infinity; None if there is none."""
    # Both stay in a sum, which is cheaper than to ask each number; a sum may also overflow.
    real = ((name, each.detach()) for name, each in tensors.items() if each.is_floating_point())
    doubtful = ((name, each) for name, each in real if not each.sum().isfinite())
    return next((name for name, each in doubtful if not each.isfinite().all()), None)


def _header_and_names(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The header, and the names of the tensors."""
    try:  # so that what the system refuses is not taken for damage
        if not stat.S_ISREG(path.stat().st_mode):  # reading a pipe would wait
            raise RunError(f"{path} is not a file: put the checkpoint there")
        path.open("rb").close()
    except OSError as error:
        raise _unreadable(path, error) from error
    with _opened(path) as file:
        return _parsed_header(path, file.metadata() or {}), list(file.keys())


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A checkpoint, mapped; DamagedCheckpointError if not whole, RunError if it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except RunError:
        raise
    except OSError as error:
        raise _unreadable(path, error) from error
    except Exception as error:  # a reader may raise anything on a file of something else
        raise DamagedCheckpointError(path, "it cannot be parsed") from error


def _parsed_header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The header, checked against its digest and of a known format. DamagedCheckpointError if it is
    not what was written, RunError if another version of the program wrote it, KeyError or
    ValueError if there is none, or it is not JSON."""
    text = metadata[_HEADER]
    expected = metadata.get(_HEADER_DIGEST)
    if expected is not None and expected != hashlib.sha256(text.encode()).hexdigest():
        raise DamagedCheckpointError(path, "its header does not match its digest")
    header: dict[str, Any] = dict(json.loads(text))
    if (version := header.get("format")) != FORMAT:
        raise RunError(
            f"{path} has checkpoint format {version!r:.20}, this program reads {FORMAT}: use the "
            f"version of mrgs that wrote it"
        )
    if expected is None:
        raise DamagedCheckpointError(path, "its header has no digest")
    return header


def _unreadable(path: Path, error: OSError) -> RunError:
    return RunError(
        f"{path} cannot be read ({error.strerror or error}): check its permissions and the disk"
    )


def _add_to(digest: Any, name: str, tensor: Tensor) -> None:
    """Add name, type, shape and contents of a tensor in host memory to a digest."""
    digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
    if tensor.numel() > 0:
        digest.update(tensor.flatten().view(torch.uint8).numpy().data)
