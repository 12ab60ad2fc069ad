"""Pictures without a display: what is where, and the preview's labels."""

from __future__ import annotations

import io
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from station.core.geometry import so3_exp
from workers.export.preview import _label, _spread, preview, views_of
from workers.measure.body import Measurement, measure_body
from workers.pictures.render import BACKGROUND, Frame, Scene
from workers.scape.model.body_model import BodyModel
from workers.scape.verdict.verdict import Verdict

OK = Verdict("ok", ())


@pytest.fixture(scope="module")
def rows(model: BodyModel) -> list[Measurement]:
    return list(measure_body(model, model.mean, np.full(model.vertex_count, 1e-3)).rows)


@pytest.mark.parametrize(
    ("view", "ball", "where"),
    [
        ("front", (0.4, 0.0, 1.3), (89.5, 19.5)),
        ("back", (0.4, 0.0, 1.3), (9.5, 19.5)),
        ("side", (0.0, 0.4, 1.3), (89.5, 19.5)),
        ("side", (0.0, -0.4, 0.6), (9.5, 89.5)),
    ],
)
def test_a_ball_off_the_centre_is_where_it_should_be(
    view: str, ball: tuple[float, float, float], where: tuple[float, float]
) -> None:
    """A camera helper's natural "up" once turned every picture by 180 degrees."""
    sphere = o3d.geometry.TriangleMesh.create_sphere(0.05).translate(ball)
    frame = Frame(view, 100, 100, 0.01, (0.0, 0.0, 1.0))
    shown = Scene(np.asarray(sphere.vertices), np.asarray(sphere.triangles)).render(frame)
    v, u = np.nonzero(np.isfinite(shown.depth_m))
    assert np.allclose((u.mean(), v.mean()), where, atol=0.6)
    assert np.allclose(frame.pixels(np.array([ball])), where)
    nearest = frame.depths(np.array([ball]))[0] - 0.05
    assert shown.depth_m.min() == pytest.approx(nearest, abs=2e-3)
    assert (shown.picture[~np.isfinite(shown.depth_m)] == BACKGROUND).mean() > 0.97


def test_triangles_take_their_colours() -> None:
    square = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 2], [-1, 0, 2]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colors = np.array([[0.0, 0.0, 255.0], [255.0, 0.0, 0.0]])
    frame = Frame("front", 50, 50, 0.03, (0.0, 0.0, 1.0))
    picture = Scene(square, faces).render(frame, colors).picture
    assert picture[40, 40, 2] > 150 > 10 > picture[40, 40, 0]
    assert picture[10, 10, 0] > 150 > 10 > picture[10, 10, 2]


def test_what_is_in_front_hides_what_is_behind() -> None:
    """Whatever the order of the triangles; those that turn away are not seen."""
    square = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 2], [-1, 0, 2]])
    vertices = np.concatenate([square, 0.5 * square + (0.0, -0.3, 0.5)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    frame = Frame("front", 50, 50, 0.05, (0.0, 0.0, 1.0))
    away = np.concatenate([faces[:2], faces[2:, ::-1]])
    for drawn, nearest in ((faces, 4), (faces[::-1], 4), (away, 0)):
        shown = Scene(vertices, drawn).render(frame)
        assert shown.depth_m[25, 25] == pytest.approx(frame.depths(vertices)[nearest])
        assert shown.depth_m[10, 10] == pytest.approx(frame.depths(vertices[:1])[0])
        assert np.isinf(shown.depth_m[2, 2])


def _decoded(content: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def test_labels_keep_clear_of_the_body_and_of_each_other(
    model: BodyModel, rows: list[Measurement]
) -> None:
    """Values once stood on the arms, and on top of each other."""
    bare = _decoded(preview(views_of(model.mean, model.faces), [], OK))
    assert bare.min() < 200
    # Two dozen lines that all end at one height have labels of their own all the same.
    crowded = _spread(np.full(12, 300.0), 24.0, 24.0, 500.0)
    assert np.diff(crowded).min() >= 24.0
    assert crowded[0] >= 24.0
    assert crowded[-1] <= 500.0
    picture = _decoded(preview(views_of(model.mean, model.faces), rows, OK))
    assert picture.shape[1] > bare.shape[1] + 400


def test_a_label_has_the_name_of_the_tables(rows: list[Measurement]) -> None:
    """The picture said "chest" and "wrist right" beside a table with other words."""
    labels = {row.name: _label(row) for row in rows}
    assert labels["chest_girth"].startswith("Chest or bust girth  ")
    assert labels["wrist_girth_right"].startswith("Wrist girth, right  ")


def test_only_a_scan_to_repeat_says_so(model: BodyModel, rows: list[Measurement]) -> None:
    good = _decoded(preview(views_of(model.mean, model.faces), rows, OK))
    verdict = Verdict("rescan", ("the cameras saw only 12 % of the left forearm", "x" * 1000))
    again = _decoded(preview(views_of(model.mean, model.faces), rows, verdict))
    assert (good[-30:] == BACKGROUND).all()
    assert (again[-30:] != BACKGROUND).any()
    assert np.array_equal(again[:-34], good[:-34])
    assert (again[:, -10:][-30:] == BACKGROUND).all()


def test_a_picture_carries_its_order(model: BodyModel) -> None:
    about = {"label": "Größe 7 \u7c97", "booth": "", "verdict": "ok"}
    content = preview(views_of(model.mean, model.faces), [], OK, about=about)
    assert np.array_equal(
        _decoded(content), _decoded(preview(views_of(model.mean, model.faces), [], OK))
    )
    with Image.open(io.BytesIO(content)) as picture:
        picture.verify()
        assert picture.info == {"label": "Größe 7 \u7c97", "verdict": "ok"}


def test_a_picture_shows_whose_it_is(model: BodyModel) -> None:
    views, about = views_of(model.mean, model.faces), {"scan_id": "20261127T232543Z-fd9b"}
    bare, named = (_decoded(preview(views, [], OK, about=texts)) for texts in ({}, about))
    assert (named[-30:] != BACKGROUND).any()
    assert np.array_equal(named[:-34], bare[:-34])


def test_a_row_that_is_not_measured_is_left_out(model: BodyModel, rows: list[Measurement]) -> None:
    some = [row for row in rows if row.name != "waist_girth"]
    assert len(preview(views_of(model.mean, model.faces), some, OK)) > 1000


def test_the_front_is_the_persons(model: BodyModel, rows: list[Measurement]) -> None:
    """Whichever way they stood."""
    turn = so3_exp(np.array([0.0, 0.0, 2.0]))
    turned = [replace(row, path=row.path @ turn.T) for row in rows]
    ahead = _decoded(preview(views_of(model.mean, model.faces), rows, OK))
    away = _decoded(preview(views_of(model.mean @ turn.T, model.faces, 2.0), turned, OK))
    assert np.mean(np.abs(ahead.astype(float) - away) > 8.0) < 0.01
