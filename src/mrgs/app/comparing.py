"""``mrgs compare``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mrgs.app.arguments import read_text
from mrgs.app.commands import CompareMethods
from mrgs.errors import ConfigError, TrainingError

if TYPE_CHECKING:
    from mrgs.comparison.table import Table


def compare(command: CompareMethods) -> None:
    """Train and score methods side by side.

    Raises:
        MrgsError: what was asked for cannot be done, or a training failed.
    """
    from mrgs.comparison import Options, Variant
    from mrgs.comparison import compare as compare_methods
    from mrgs.comparison.table import to_plain

    variants = _named_paths("--variants", command.variants, "wide=wide.yaml")
    options = Options(
        command.methods,
        tuple(
            Variant.from_text(name, read_text(file), str(file)) for name, file in variants.items()
        ),
        command.neighbours,
        command.seeds,
        command.preset,
        command.max_steps,
        command.max_gaussians,
        command.resolution,
    )
    try:
        comparison = compare_methods(
            command.scenes,
            command.output,
            options,
            renders=_named_paths("--renders", command.renders, "ThermoNeRF=renders/thermonerf"),
            jobs=command.jobs,
            device=command.device,
            lpips_weights=command.lpips_weights,
            say=lambda line: print(line, flush=True),
        )
    except KeyboardInterrupt:
        print("interrupted runs keep their checkpoints; re-run the same command to resume")
        raise
    for table in comparison.tables:
        print("\n" + to_plain(table), end="")
    for line in how_to_read(comparison.tables, command.seeds):
        print(line)
    print(f"tables: {command.output / 'tables'}\nfigures: {command.output / 'figures'}")
    if comparison.failures:
        name, reason = next(iter(comparison.failures.items()))
        raise TrainingError(
            f"{len(comparison.failures)} rows of the tables have no scores, first {name} "
            f"({reason}); fix the cause and re-run the same command"
        )


def how_to_read(tables: Sequence[Table], seeds: int) -> list[str]:
    """What the signs of printed tables mean, and whether differences may be by chance."""
    from mrgs.comparison.table import marks

    lines = []
    if any(any(row) for table in tables for row in marks(table)):
        lines.append("*: the best, +: the second best of what was measured here")
    if tables and seeds == 1:
        lines.append("one seed: small differences may be by chance; --seeds 3 shows the spread")
    return lines


def _named_paths(option: str, pairs: tuple[str, ...], example: str) -> dict[str, Path]:
    """Paths by name, from NAME=PATH."""
    named = {}
    for pair in pairs:
        name, separator, path = pair.partition("=")
        if not separator or not name or not path:
            raise ConfigError(f"{option} {pair}: use NAME=PATH, for example {example}")
        if name in named:
            raise ConfigError(f"{option} {pair}: {name} is used twice; choose another name")
        named[name] = Path(path)
    return named
