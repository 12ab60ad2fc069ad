"""Values that no honest sender has."""

from __future__ import annotations

from typing import Any

STRANGE: tuple[Any, ...] = (
    None, True, -1, 0, 2**63, 10**400, 1e308, -1e-320, float("nan"), float("inf"), "", "x" * 300,
    [], {}, [[]], {"a": {"b": []}}, "../../escape", "\x1b[2J\n", "é" * 70, 4_000_000_000, "0\x00",
    "\ud800", [float("nan")] * 9, "/dev/zero",
)  # fmt: skip
