"""reconstruct fit --debug: a picture of each stage, and the same result."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from station.core.errors import InputError
from workers.pictures.debug_pictures import DebugPictures
from workers.pictures.render import BACKGROUND
from workers.reconstruct.fit_cli import fit
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals


def _ink(path: Path) -> float:
    picture = cv2.imread(str(path))
    assert picture is not None, path
    return float((picture != BACKGROUND).any(axis=2).mean())


def test_the_error_map_shows_where_the_points_lie(model: BodyModel, tmp_path: Path) -> None:
    draw = DebugPictures(tmp_path / "pictures", model.faces)
    draw("cloud", {"points": model.mean, "normals": vertex_normals(model.mean, model.faces)})
    reddest = []
    for name, chest_m in (("met", 0.0), ("outside", 0.004), ("inside", -0.004)):
        residual = np.zeros(model.vertex_count)
        residual[model.part_of_vertex == model.part_names.index("chest")] = chest_m
        residual[model.part_of_vertex == model.part_names.index("shin_left")] = np.nan
        draw("surface", {"vertices": model.mean, "residual_m": residual})
        picture = cv2.imread(str(tmp_path / "pictures/5-surface.png"))
        assert picture is not None
        channels = picture.astype(int)[40:].reshape(-1, 3)
        blue, green, red = channels.T
        reddest.append((name, int((red - blue > 60).sum()), int((blue - red > 60).sum())))
        assert green.min() < 200
    (_, *met), (_, outside, none), (_, nothing, inside) = reddest
    assert met == [0, 0]
    assert none == nothing == 0
    assert min(outside, inside) > 2000


def test_every_stage_is_drawn(bundle: Path, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    words = [str(bundle), "--out", str(tmp_path / "out"), "--debug", str(pictures), "--quiet"]
    done = CliRunner().invoke(fit, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in pictures.iterdir())
    rounds = [name for name in names if name.startswith("3-correspondences-")]
    # The first of each stage and the last: neighbours looked the same.
    assert [int(name[-6:-4]) for name in rounds] == [1, 5, 9, 12, 15, 17]
    others = ["1-cloud.png", "2-start.png", "4-joint.png", "5-surface.png", "6-done.png"]
    assert [name for name in names if name not in rounds] == others
    for name in names:
        assert 0.08 < _ink(pictures / name) < 0.6, name
    # Pictures of a body are as private as its scan.
    assert pictures.stat().st_mode & 0o077 == 0
    # Pictures of two fits lay in one folder, where nobody could tell them apart.
    words[2] = str(tmp_path / "other")
    with pytest.raises(InputError, match=r"has pictures of a fit already; .* with --debug"):
        CliRunner().invoke(fit, words, catch_exceptions=False)
    assert not (tmp_path / "other").exists()


def test_rounds_of_a_long_stage_are_drawn_now_and_then(model: BodyModel, tmp_path: Path) -> None:
    draw = DebugPictures(tmp_path / "pictures", model.faces)
    draw("cloud", {"points": model.mean, "normals": vertex_normals(model.mean, model.faces)})
    some = model.mean[::50]
    pairs = {"vertices": model.mean, "on_body": some, "on_cloud": some + 0.01}
    for _ in range(8):
        draw("correspondences", {**pairs, "gate_m": np.array(0.05)})
    draw("joint", {"vertices": model.mean})
    names = sorted(path.name for path in (tmp_path / "pictures").glob("3-*"))
    assert names == [f"3-correspondences-{number:02d}.png" for number in (1, 6, 8)]


def test_folders_that_cannot_be_made_are_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "nowhere").symlink_to("nothing")
    (tmp_path / "loop").symlink_to("loop")
    places = (
        ("--out", "file/result", "cannot be written"),
        ("--out", "nowhere", "exists already"),
        ("--out", "loop/result", "cannot be made"),
        # Root may write there, but nothing can be made.
        ("--out", "/proc/result", "cannot be written"),
        ("--debug", "file", "cannot be written"),
        ("--debug", "loop/pictures", "cannot be written"),
    )
    for option, place, words in places:
        options = {"--out": tmp_path / "out", option: tmp_path / place}
        listed = [str(word) for pair in options.items() for word in pair]
        with pytest.raises(InputError, match=f"{words}.*{option}"):
            CliRunner().invoke(fit, [str(tmp_path), *listed], catch_exceptions=False)
    assert not (tmp_path / "out").exists()
