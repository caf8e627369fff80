"""What an attack tried, and what did not hold."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Tally:
    """The outcome of an attack.

    Attributes:
        tried: number of cases.
        failures: one line for each case that did not hold.
        figure: what was measured beside that; may be empty.
    """

    tried: int = 0
    failures: list[str] = field(default_factory=list)
    figure: str = ""

    def judge(self, case: str, holds: bool, seen: object = "") -> None:
        """Count a case; what was seen is kept if it did not hold."""
        self.tried += 1
        if not holds:
            self.failures.append(f"{case}: {seen}")
