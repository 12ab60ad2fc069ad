"""The database's bodies beside what is published of people's sizes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from station.core.errors import InputError
from workers.measure.body import measure_body
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

PUBLISHED_CM = {
    "men": {
        "height": (175.6, 6.9),
        "chest_girth": (105.9, 8.7),
        "waist_girth": (94.1, 11.2),
        "hip_girth": (102.0, 7.7),
        "thigh_girth_left": (62.5, 5.8),
    },
    "women": {
        "height": (162.8, 6.4),
        "chest_girth": (94.7, 8.3),
        "waist_girth": (86.1, 10.0),
        "hip_girth": (102.1, 7.6),
        "thigh_girth_left": (61.7, 5.7),
    },
}
"""Mean and standard deviation in the 2012 survey of U.S. Army personnel (ANSUR II, Gordon et al.
2014, NATICK/TR-15/007; 4,082 men, 1,986 women): fit people, waists at the navel."""
PUBLIC_WAIST_CM = {"men": 102.0, "women": 98.0}
"""Mean waist of adults in the United States (NHANES 2015-2018, Fryar et al. 2021, Vital and Health
Statistics 3-46)."""


def population_table(model: BodyModel, bodies: Array, female: NDArray[np.bool_]) -> Iterator[str]:
    """Sizes in centimetres of bodies (n, P, 3) in the neutral pose, lines of a table."""
    yield f"population: {len(bodies)} bodies here against ANSUR II (cm)"
    yield "                             here                     published"
    yield "                       mean   sd    p5   p95     mean   sd    p5*  p95*"
    for sex, chosen in (("men", ~female), ("women", female)):
        sizes = _sizes(model, bodies[chosen], tuple(PUBLISHED_CM[sex]))
        for name, (mean, deviation) in PUBLISHED_CM[sex].items():
            here = sizes[name]
            low, high = np.quantile(here, [0.05, 0.95])
            yield (
                f" {sex:<5} {name.removesuffix('_left'):<13}"
                f"{here.mean():7.1f}{here.std():5.1f}{low:6.1f}{high:6.1f}"
                f"   {mean:6.1f}{deviation:5.1f}"
                f"{mean - 1.645 * deviation:7.1f}{mean + 1.645 * deviation:6.1f}"
            )
    waists = ", ".join(f"{sex} {mean:.0f}" for sex, mean in PUBLIC_WAIST_CM.items())
    yield f" * of a normal distribution. Mean waist of the public (NHANES 2015-2018): {waists} cm"


def _sizes(model: BodyModel, bodies: Array, names: tuple[str, ...]) -> dict[str, Array]:
    """Measured values in centimetres; a body that a plane misses is left out."""
    found: dict[str, list[float]] = {name: [] for name in names}
    for body in bodies:
        try:
            rows = measure_body(model, body).rows
        except InputError:
            continue
        for row in rows:
            if row.name in found:
                found[row.name].append(100.0 * row.value_m)
    return {name: np.array(values) for name, values in found.items()}
