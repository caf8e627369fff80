"""Compiles every Triton kernel of the package for a GPU that need not be there, and prints what
each takes as JSON.

``python -m benchmarks.gpu_compile CAPABILITY [NAME ...]`` compiles the named ones, or all;
``python -m benchmarks.gpu_compile sources`` prints digests of what they are compiled from. Both are
started by ``gpu_resources`` in processes of their own: Triton decides when it is imported whether
it interprets.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import re
import sys
from collections.abc import Collection, Iterable
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import mrgs
from mrgs.kernels import gpu_spec
from mrgs.kernels.gpu_spec import KernelSpec

ALIGNMENT_BYTES = 16
"""Where Triton finds a tensor's first element at a multiple of this, it loads several elements at
once."""

SOURCE = Path(mrgs.__file__).parent


def kernel_modules() -> list[ModuleType]:
    """Every module of the package whose source mentions ``triton.jit`` or ``KERNELS``, imported."""
    paths = [
        path.relative_to(SOURCE.parent)
        for path in sorted(SOURCE.rglob("*.py"))
        if _mentions_kernels(path)
    ]
    names = [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return [importlib.import_module(name) for name in names if name != gpu_spec.__name__]


def _mentions_kernels(path: Path) -> bool:
    return re.search(r"triton\.jit|\bKERNELS\b", path.read_text(encoding="utf-8")) is not None


def listed(modules: Iterable[ModuleType]) -> dict[str, KernelSpec]:
    """The specialisations of all lists, by folder and name of the kernel ("rasterize:
    blend[rgb]").

    Raises:
        ValueError: two specialisations of a list have the same name.
    """
    specs: dict[str, KernelSpec] = {}
    for spec in (spec for module in modules for spec in getattr(module, "KERNELS", ())):
        key = f"{spec.kernel.fn.__module__.split('.')[2]}: {spec.name}"
        if specs.setdefault(key, spec) is not spec:
            raise ValueError(
                f"two entries of KERNELS are called {key}: tell them apart by their variant"
            )
    return specs


def unlisted(modules: Iterable[ModuleType], specs: Iterable[KernelSpec]) -> list[str]:
    """Names of the kernels that no list has; what other kernels call is no kernel of its own."""
    found = _jitted(modules)
    known = {id(spec.kernel) for spec in specs}
    called = {name for function in found for name in function.fn.__code__.co_names}
    missing = [function.fn for function in found if id(function) not in known]
    return sorted(f"{fn.__module__}.{fn.__name__}" for fn in missing if fn.__name__ not in called)


def _jitted(modules: Iterable[ModuleType]) -> list[Any]:
    """The functions of modules that Triton compiles, each once."""
    values = (value for module in modules for value in vars(module).values())
    return list({id(value): value for value in values if _is_jitted(value)}.values())


def _is_jitted(value: object) -> bool:
    """Whether ``@triton.jit`` made this, in the package rather than in Triton's own library."""
    fn = getattr(value, "fn", None)
    return (
        hasattr(value, "arg_names") and getattr(fn, "__module__", "").split(".")[0] == SOURCE.name
    )


def resources(spec: KernelSpec, capability: int) -> dict[str, int]:
    """Registers per thread, bytes of spills and of stack per thread, and bytes of shared memory per
    program.

    Raises:
        ValueError: the entry names other arguments than the kernel has.
    """
    from triton import compile as compile_kernel
    from triton.backends.compiler import GPUTarget

    source = _source(spec)
    log = io.StringIO()
    with redirect_stdout(log):
        compiled = compile_kernel(
            source,
            target=GPUTarget("cuda", capability, 32),
            options={"num_warps": spec.num_warps, "num_stages": spec.num_stages},
        )
    return {
        **parse_log(log.getvalue()),
        "shared": compiled.metadata.shared,
        "warps": spec.num_warps,
    }


def _source(spec: KernelSpec) -> Any:
    """What Triton compiles: the function with the types and constants of its arguments."""
    from triton.compiler import ASTSource

    names = spec.kernel.arg_names
    types = {
        name: "constexpr" if name in spec.constexprs else spec.signature.get(name) for name in names
    }
    given = {*spec.signature, *spec.constexprs}
    if set(names) != given or len(given) != len(spec.signature) + len(spec.constexprs):
        raise ValueError(
            f"{spec.name} takes {', '.join(names)}; its entry of KERNELS gives "
            f"{', '.join(sorted(given))}"
        )
    attributes = {
        (i,): [["tt.divisibility", ALIGNMENT_BYTES]]
        for i, name in enumerate(names)
        if str(types[name]).startswith("*")
    }
    constants = {(names.index(name),): value for name, value in spec.constexprs.items()}
    return ASTSource(spec.kernel, types, constants, attributes)


def parse_log(log: str) -> dict[str, int]:
    """What ``ptxas -v`` says; of a kernel and the functions it does not inline, the most registers
    and all spills.

    Raises:
        ValueError: the text has no such lines.
    """
    registers = [int(n) for n in re.findall(r"Used (\d+) registers", log)]
    pattern = r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
    frames = [tuple(map(int, frame)) for frame in re.findall(pattern, log)]
    if not registers or not frames:
        raise ValueError(f"ptxas said nothing of its registers and spills: {log.strip()!r}")
    stack, stores, loads = (sum(column) for column in zip(*frames, strict=True))
    return {
        "registers": max(registers),
        "spill_stores": stores,
        "spill_loads": loads,
        "stack": stack,
    }


def compile_listed(capability: int, names: Collection[str] = ()) -> dict[str, dict[str, int]]:
    """The resources of the specialisations of these names, or of all.

    Raises:
        RuntimeError: a specialisation cannot be compiled; the message names it.
    """
    specs = listed(kernel_modules())
    return {name: _compiled(name, specs[name], capability) for name in names or specs}


def read_sources() -> dict[str, Any]:
    """Triton's version, the unlisted kernels, and a digest of each specialisation: of its source
    and of what it calls, of constants, types and launch options. Line numbers do not count."""
    modules = kernel_modules()
    import triton

    specs = listed(modules)
    for function in _jitted(modules):
        function.starting_line_number = 0
    digests = {
        name: hashlib.sha256(
            f"{_source(spec).hash()} {spec.num_warps} {spec.num_stages}".encode()
        ).hexdigest()[:16]
        for name, spec in specs.items()
    }
    return {
        "triton": triton.__version__,
        "unlisted": unlisted(modules, specs.values()),
        "sources": digests,
    }


def _compiled(name: str, spec: KernelSpec, capability: int) -> dict[str, int]:
    try:
        return resources(spec, capability)
    except Exception as error:
        raise RuntimeError(f"{name} cannot be compiled for sm_{capability}") from error


if __name__ == "__main__":
    what, *wanted = sys.argv[1:]
    found = read_sources() if what == "sources" else compile_listed(int(what), wanted)
    sys.stdout.write(json.dumps(found))
