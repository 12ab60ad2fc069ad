"""Who watches a fit: called with what each stage has at hand, and never asked for anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

Stage = Literal["cloud", "start", "correspondences", "joint", "surface", "done"]


class Observer(Protocol):
    """Watches a fit; must not write to the arrays, which are the fit's own.

    Stages in order, with their arrays (world frame, metres; P vertices of the template):

    - "cloud": `points` (n, 3), `normals` (n, 3), what is fitted to.
    - "start": `vertices` (P, 3), the body before the first step.
    - "correspondences", once an iteration: `vertices` (P, 3), and `on_body` and `on_cloud`, (m, 3)
      each, the pairs that pull it.
    - "joint": `vertices` (P, 3) of the fitted model.
    - "surface": `vertices` (P, 3) laid on the data, `residual_m` (P,), the mean signed distance of
      a vertex' points along its normal, NaN where it has none.
    - "done": `vertices` (P, 3) as they are delivered.
    """

    def __call__(self, stage: Stage, arrays: Mapping[str, NDArray[Any]]) -> None: ...


def unobserved(stage: Stage, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Nobody watches."""
