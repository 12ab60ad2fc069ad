"""Sample vertices that represent the body: a few while the fit is coarse, more when it is fine."""

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
"""Vertices whose derivatives are computed."""
_COARSE_PLACES = 1200
"""Vertices that represent the surface while the fit is coarse."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """Nested sample vertices with the model's derivatives, and which vertices they represent."""

    body: SampledBody
    coarse_body: SampledBody
    """The first of these vertices: the surface in the coarse steps."""
    normals: Array
    """(m, 3): normals of the coarse body's vertices on the mean body."""
    weights: Array
    """(m, L): shares of the parts in these vertices."""
    share: Array
    """(m,): area that each of them represents, in units of an average vertex's."""
    coarse_sample: NDArray[np.intp]
    """(m,): the coarse sample nearest to each of them."""
    sample_of_vertex: NDArray[np.intp]
    """(P,): the sample nearest to each vertex."""
    hands: tuple[Hand, ...]

    @classmethod
    def build(cls, model: BodyModel) -> Sampling:
        """Evenly spread samples, of which the first ones alone are evenly spread too."""
        order = _spread(model)
        places = model.mean[order]
        coarse = places[:_COARSE_PLACES]
        coarse_of_vertex = cKDTree(coarse).query(model.mean)[1]
        body = SampledBody.build(model, order)
        return cls(
            body,
            body.first(_COARSE_PLACES),
            vertex_normals(model.mean, model.faces)[order[:_COARSE_PLACES]],
            model.vertex_weights[order[:_COARSE_PLACES]],
            np.bincount(coarse_of_vertex, model.vertex_shares, _COARSE_PLACES).astype(np.float64),
            cKDTree(places[:COARSE_SAMPLES]).query(coarse)[1],
            cKDTree(places).query(model.mean)[1],
            hands_of(model),
        )

    def coarse_skin(self, model: BodyModel, state: BodyState) -> Skin:
        """Skin of the coarse steps; its normals are rotated with the parts."""
        turns = self.weights @ state.rotations.reshape(-1, 9)
        normals = np.einsum("nij,nj->ni", turns.reshape(-1, 3, 3), self.normals)
        return Skin(
            self.coarse_body.evaluate(state),
            normals / np.linalg.norm(normals, axis=1, keepdims=True),
            model.part_of_vertex[self.coarse_body.indices],
            self.share,
            self.coarse_sample,
        )

    def skin(self, model: BodyModel, state: BodyState) -> Skin:
        """Skin of the fine steps: every vertex."""
        vertices = model.vertices(state)
        return Skin(
            vertices,
            vertex_normals(vertices, model.faces),
            model.part_of_vertex,
            model.vertex_shares,
            self.sample_of_vertex,
        )


def _spread(model: BodyModel) -> NDArray[np.int64]:
    """Order of vertices, each the farthest from those before it on the mean body.

    Vertices of small area wait, so that folds of soles and face do not take all the samples.
    """
    areas = np.sqrt(vertex_areas(model.mean, model.faces))
    reach = np.minimum(areas / np.median(areas), 1.0)
    return farthest_first(model.mean, FINE_SAMPLES, start=model.landmarks["crown"], reach=reach)
