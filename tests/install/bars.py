"""Bars of an installed booth: what was measured, and whether it was met."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Table:
    """Rows in the order in which they were measured."""

    rows: list[str] = field(default_factory=list)

    def add(self, what: str, value: float, bar: float, unit: str = "s") -> None:
        """Add a row; lower is better."""
        word = "met" if value <= bar else "missed"
        self.rows.append(f"{what:<48} {value:8.1f} {unit:<3} bar {bar:g} {unit}: {word}")

    def __str__(self) -> str:
        return "\n".join(self.rows)


TABLE = Table()
"""The table of this run; a slow machine fails no test."""
