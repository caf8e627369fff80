"""The file of a checkpoint: tensors in safetensors, a header of JSON, and digests of both.

The header lists the tensors' digest, and the file's second metadata entry is the digest of the
header: a bit that changed anywhere is noticed when the file is read.
"""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor

from mrgs.errors import DamagedCheckpointError, NotFiniteError, RunError
from mrgs.system.atomic import replacing

FORMAT = 6

WITHOUT_DIGESTS = 5
"""The last format without digests; still read."""

_HEADER = "mrgs"
_HEADER_DIGEST = "sha256"
_TENSORS_DIGEST = "tensors_sha256"


def write_file(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write a checkpoint that is either whole or not there.

    Args:
        path: the file.
        tensors: by name, on any device.
        header: more entries, for JSON.

    Raises:
        NotFiniteError: a tensor holds a NaN or an infinity; nothing is written.
        RunError: the file cannot be written.
    """
    if (name := first_not_finite(tensors)) is not None:
        raise NotFiniteError(f"{name} holds values that are not finite: {path.name} is not written")
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    text = json.dumps({**header, "format": FORMAT, _TENSORS_DIGEST: _digest_of(kept)})
    metadata = {_HEADER: text, _HEADER_DIGEST: hashlib.sha256(text.encode()).hexdigest()}
    with replacing(path) as temporary:
        safetensors.torch.save_file(kept, temporary, metadata)


def read_header(path: Path) -> dict[str, Any]:
    """The header alone; its own digest is checked, the tensors are not read.

    Raises:
        DamagedCheckpointError: not a checkpoint, or another header than was written.
        RunError: the file cannot be read, or is of another format.
    """
    return _header_and_names(path)[0]


def read_file(
    path: Path, needed: Callable[[str], bool] = lambda name: True
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors by name, and the header.

    All tensors are read and checked, one after the other, so that those that are not needed take
    little memory.

    Args:
        path: the file.
        needed: whether the tensor of a name is to be returned.

    Raises:
        DamagedCheckpointError: not a checkpoint, not what was written, or not finite.
        RunError: the file cannot be read, or is of another format.
    """
    header, names = _header_and_names(path)
    digest = hashlib.sha256()
    tensors: dict[str, Tensor] = {}
    broken = None
    for name in sorted(names):
        tensor = _read_tensor(path, name)
        _add_to(digest, name, tensor)
        broken = broken or first_not_finite({name: tensor})
        if needed(name):
            tensors[name] = tensor
    if header["format"] != WITHOUT_DIGESTS and header.get(_TENSORS_DIGEST) != digest.hexdigest():
        raise DamagedCheckpointError(path, "its tensors do not match their digest")
    if broken is not None:
        raise DamagedCheckpointError(path, f"{broken} holds values that are not finite")
    return tensors, header


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of a tensor that holds a NaN or an infinity; None if there is none."""
    for name, tensor in tensors.items():
        # Both stay in a sum, which is cheaper than to ask each number; a sum may also overflow.
        if (
            tensor.is_floating_point()
            and not tensor.detach().sum().isfinite()
            and not tensor.isfinite().all()
        ):
            return name
    return None


def _header_and_names(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The header, and the names of the tensors."""
    _require_readable(path)
    with _opened(path) as file:
        return _parsed_header(path, file.metadata() or {}), list(file.keys())


def _read_tensor(path: Path, name: str) -> Tensor:
    """A tensor, in memory of its own: a mapped file that someone cuts off would end the process."""
    # Pages of the file count as the process's memory until it is closed.
    with _opened(path) as file:
        return file.get_tensor(name).clone()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A checkpoint, mapped.

    Raises:
        DamagedCheckpointError: it is of another kind, or cut off.
        RunError: it cannot be read.
    """
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
    """The header, which is that of a known format and has its digest.

    Raises:
        DamagedCheckpointError: it is not what was written.
        RunError: another version of the program wrote it.
        KeyError, ValueError: there is none, or it is not JSON.
    """
    text = metadata[_HEADER]
    expected = metadata.get(_HEADER_DIGEST)
    if expected is not None and expected != hashlib.sha256(text.encode()).hexdigest():
        raise DamagedCheckpointError(path, "its header does not match its digest")
    header: dict[str, Any] = dict(json.loads(text))
    version = header.get("format")
    if version == FORMAT and expected is None:
        raise DamagedCheckpointError(path, "its header has no digest")
    if version not in (FORMAT, WITHOUT_DIGESTS):
        raise RunError(
            f"{path} has checkpoint format {version!r:.20}, this program reads {WITHOUT_DIGESTS} "
            f"and {FORMAT}: use the version of mrgs that wrote it"
        )
    return header


def _require_readable(path: Path) -> None:
    """Open the file once, so that what the system refuses is not taken for damage.

    Raises:
        RunError: it is not there, not a file, or cannot be opened.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe would be waited for
            raise RunError(f"{path} is not a file: put the checkpoint there")
        path.open("rb").close()
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> RunError:
    return RunError(
        f"{path} cannot be read ({error.strerror or error}): check its permissions and the disk"
    )


def _digest_of(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and contents of tensors in the host's memory."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        _add_to(digest, name, tensors[name])
    return digest.hexdigest()


def _add_to(digest: Any, name: str, tensor: Tensor) -> None:
    """Let a tensor count in a digest."""
    digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
    if tensor.numel() > 0:
        digest.update(tensor.flatten().view(torch.uint8).numpy().data)
