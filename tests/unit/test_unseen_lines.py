"""Rows without a value, and rows whose line no camera saw."""

from dataclasses import replace

import numpy as np
import pytest

from station.core.errors import InputError
from workers.export.origin import Origin
from workers.export.result import measurements_document
from workers.measure.body import measure_body
from workers.measure.coverage import SeenSkin
from workers.measure.kinds import TRUNK_ENDS
from workers.measure.scan_errors import ScanErrors
from workers.measure.tracing import trace_all
from workers.scape.model.body_model import BodyModel


@pytest.mark.filterwarnings("error")
def test_a_broken_body_is_an_error_that_names_the_row(model: BodyModel) -> None:
    """Two exchanged cameras gave a crushed one, of which numpy complained in the terminal."""
    crushed = model.mean.copy()
    neck, crotch = (model.landmarks[name] for name in TRUNK_ENDS)
    # Skin counts within a share of the distance between them.
    crushed[neck] = crushed[crotch] + 1e-9
    with pytest.raises(InputError, match="its landmarks give no direction; fit the body again"):
        trace_all(model, crushed)
    flat = model.mean * (1.0, 1.0, 0.0)
    with pytest.raises(InputError, match="cannot be measured"):
        trace_all(model, flat)
    torn = model.mean.copy()
    torn[100] = np.nan
    with pytest.raises(InputError, match="not numbers"):
        trace_all(model, torn)


def test_a_landmark_far_astray_blanks_its_own_rows_alone(model: BodyModel) -> None:
    """One knee in a torn cloud ended the whole result."""
    spiked = model.mean.copy()
    spiked[model.landmarks["knee_left"], 2] = 3.0
    document = measurements_document(Origin("s1"), measure_body(model, spiked))
    blank = {row["name"] for row in document["measurements"] if row["value_m"] is None}
    assert blank == {"knee_girth_left"}
    assert "knee_girth" not in {row["name"] for row in document["differences"]}


@pytest.mark.parametrize("bow_deg", range(0, 60, 5))
def test_a_chin_on_the_chest_blanks_the_neck_alone(model: BodyModel, bow_deg: int) -> None:
    """Around shoulders and chin together, a neck of 53 cm was measured as 91."""
    twists = np.zeros((model.part_count, 3))
    for part in ("neck", "head"):
        twists[model.part_names.index(part), 0] = np.radians(bow_deg)
    bowed = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
    document = measurements_document(Origin("s1"), measure_body(model, model.vertices(bowed)))
    blank = {row["name"]: row for row in document["measurements"] if row["value_m"] is None}
    assert set(blank) == ({"neck_girth"} if bow_deg > 25 else set())
    assert all(row["path"] == [] and row["interval95_m"] is None for row in blank.values())
    neck = next(row for row in document["measurements"] if row["name"] == "neck_girth")
    assert bow_deg > 25 or neck["value_m"] == pytest.approx(0.35, abs=0.015)


def test_a_row_says_whether_cameras_saw_its_line(model: BodyModel) -> None:
    """The front alone: what runs along the front is seen, the back's is the model's."""
    seen = model.mean[:, 1] < model.mean[model.landmarks["waist_side_left"], 1]
    skin = SeenSkin.build(model, model.mean, seen)
    traces = trace_all(model, model.mean)
    names = [trace.definition.name for trace in traces]
    basis = dict(zip(names, skin.bases(traces), strict=True))
    assert basis["across_front_skin_width"] == basis["crotch_length_front"] == "seen"
    assert basis["waist_girth"] == basis["belly_girth"] == "partly"
    assert basis["crotch_length_back"] == basis["across_back_skin_width"] == "inferred"
    assert {row.basis for row in measure_body(model, model.mean).rows} == {"seen"}


def test_a_height_is_seen_where_the_head_was_seen_to_end(model: BodyModel) -> None:
    """No camera has readings of a crown."""
    sigma = np.full(model.vertex_count, 1e-3)
    nothing = np.zeros(model.vertex_count, bool)
    basis = {
        crown: {
            row.name: row.basis
            for row in measure_body(
                model, model.mean, sigma, nothing, ScanErrors(crown_sigma_m=crown)
            ).rows
        }["height"]
        for crown in (0.0, 0.008)
    }
    assert basis == {0.0: "seen", 0.008: "inferred"}
