"""Sample vertices that represent the body: few while the fit is coarse, more when it is fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.evidence.rows import Skin
from workers.scape.fit.hands import Hand, hands_of
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_areas, vertex_normals
from workers.scape.model.sampled import SampledBody
from workers.scape.model.spread import farthest_first

Array = NDArray[np.float64]

COARSE_SAMPLES, FINE_SAMPLES = 600, 2000
_SCOUTS = 1200


@dataclass(frozen=True, slots=True)
class Sampling:
    """Nested sample vertices with the model's derivatives, and who stands for whom."""

    body: SampledBody
    scouts: SampledBody
    """The first ones: all the skin that the coarse stages look at."""
    normals: Array
    """(m, 3): of the scouts, on the mean body."""
    share: Array
    """(m,): the area that each scout stands for, in those of an average vertex."""
    coarse_of_scout: NDArray[np.intp]
    sample_of_vertex: NDArray[np.intp]
    hands: tuple[Hand, ...]

    @classmethod
    def build(cls, model: BodyModel) -> Sampling:
        """Samples spread evenly; the first ones alone are spread evenly too."""
        order = _spread(model)
        places = model.mean[order]
        scouts = places[:_SCOUTS]
        scout_of_vertex = cKDTree(scouts).query(model.mean)[1]
        body = SampledBody.build(model, order)
        return cls(
            body,
            body.first(_SCOUTS),
            vertex_normals(model.mean, model.faces)[order[:_SCOUTS]],
            np.bincount(scout_of_vertex, model.vertex_shares, _SCOUTS).astype(np.float64),
            cKDTree(places[:COARSE_SAMPLES]).query(scouts)[1],
            cKDTree(places).query(model.mean)[1],
            hands_of(model),
        )

    def coarse_skin(self, model: BodyModel, state: BodyState) -> Skin:
        """The scouts, their normals turned with the parts."""
        index = self.scouts.indices
        turns = model.vertex_weights[index] @ state.rotations.reshape(-1, 9)
        normals = np.einsum("nij,nj->ni", turns.reshape(-1, 3, 3), self.normals)
        return Skin(
            self.scouts.evaluate(state),
            normals / np.linalg.norm(normals, axis=1, keepdims=True),
            model.part_of_vertex[index],
            self.share,
            self.coarse_of_scout,
        )

    def skin(self, model: BodyModel, state: BodyState) -> Skin:
        """Every vertex."""
        vertices = model.vertices(state)
        return Skin(
            vertices,
            vertex_normals(vertices, model.faces),
            model.part_of_vertex,
            model.vertex_shares,
            self.sample_of_vertex,
        )


def _spread(model: BodyModel) -> NDArray[np.int64]:
    """Farthest-point order on the mean body, started from a fixed vertex; the soles' and the
    face's folds count by area, so that neither takes all the samples."""
    areas = np.sqrt(vertex_areas(model.mean, model.faces))
    reach = np.minimum(areas / np.median(areas), 1.0)
    return farthest_first(model.mean, FINE_SAMPLES, start=model.landmarks["crown"], reach=reach)
