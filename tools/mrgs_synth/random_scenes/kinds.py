"""The kinds of random scenes, and how one is drawn until it is usable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from mrgs_synth.random_scenes.checks import faults
from mrgs_synth.random_scenes.circuit_board import circuit_board
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.house import house
from mrgs_synth.random_scenes.machine import machine
from mrgs_synth.random_scenes.roof import roof
from mrgs_synth.random_scenes.room import room
from mrgs_synth.stage import Stage

RandomKind = Literal["room", "house", "circuit", "roof", "machine"]
ATTEMPTS = 60


@dataclass(frozen=True)
class Kind:
    """A kind of scene.

    Attributes:
        build: draws one; it may turn out unusable.
        share_seen: share of every picture that shows surfaces.
        number: of the kind; it separates the draws of kinds.
    """

    build: Callable[[Draw], Stage]
    share_seen: float
    number: int


KINDS: dict[RandomKind, Kind] = {
    "room": Kind(room, 1.0, 1),
    "house": Kind(house, 0.4, 2),
    "circuit": Kind(circuit_board, 0.75, 3),
    "roof": Kind(roof, 0.6, 4),
    "machine": Kind(machine, 1.0, 5),
}


def drawn_kind(seed: int) -> RandomKind:
    """The kind that a seed chooses."""
    return Draw([seed, 100]).one_of(*KINDS)


def drawn_stage(kind: RandomKind, seed: int) -> Stage:
    """The first usable scene that the seed draws.

    Raises:
        RuntimeError: none of ``ATTEMPTS`` was usable.
    """
    found: list[str] = []
    for attempt in range(ATTEMPTS):
        stage = KINDS[kind].build(Draw([seed, 100 + KINDS[kind].number, attempt]))
        found = faults(stage, KINDS[kind].share_seen)
        if stage.sky is None and not stage.lamps:
            found.append("there is no light")
        if not found:
            return stage
    raise RuntimeError(f"{kind} {seed}: {ATTEMPTS} attempts, the last one: {found[0]}")
