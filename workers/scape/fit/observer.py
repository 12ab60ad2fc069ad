"""Observer of a fit: a function that is called with the arrays of each event."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

Event = Literal["cloud", "start", "correspondences", "joint", "surface", "done"]


class Observer(Protocol):
    """Function that is called at the events of a fit; it must not write to the arrays.

    Events in order, with their arrays (world frame, metres; P vertices of the template):

    - "cloud": `points` (n, 3), `normals` (n, 3), the points that are fitted to.
    - "start": `vertices` (P, 3), the body before the first step.
    - "correspondences", once an iteration: `vertices` (P, 3), `on_body` and `on_cloud`, (m, 3)
      each, the pairs, and `gate_m` (), their largest distance, which is less in each stage.
    - "joint": `vertices` (P, 3) of the fitted model.
    - "surface": `vertices` (P, 3) fitted to the data, `residual_m` (P,), mean signed distance of
      a vertex's points along its normal, NaN where it has none.
    - "done": `vertices` (P, 3) as they are delivered.
    """

    def __call__(self, event: Event, arrays: Mapping[str, NDArray[Any]]) -> None: ...


def unobserved(event: Event, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Do nothing."""
