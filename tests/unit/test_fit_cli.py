"""`reconstruct fit`: where its result goes."""

from __future__ import annotations

from pathlib import Path

import open3d as o3d
import pytest
from click.testing import CliRunner

from station.core.errors import InputError
from station.simulation.scene import load_mesh
from workers.reconstruct.fit_cli import _publish, fit

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"


def test_a_result_whose_name_was_taken_during_the_fit_is_kept(tmp_path: Path) -> None:
    made = tmp_path / ".fit-x7"
    made.mkdir()
    (made / "mesh.ply").write_bytes(b"a body")
    other = tmp_path / "result"
    other.mkdir()
    with pytest.raises(InputError, match=r"the result is in .*result-x7"):
        _publish(made, other)
    assert (tmp_path / "result-x7/mesh.ply").read_bytes() == b"a body"
    assert not list(other.iterdir())


def test_a_cloud_that_is_given_as_a_bundle_is_told_its_option(tmp_path: Path) -> None:
    done = CliRunner().invoke(fit, [str(tmp_path / "body.ply"), "--out", str(tmp_path / "r")])
    assert done.exit_code == 2
    assert "body.ply is no scan bundle" in done.output
    assert "--cloud" in done.output


def test_half_a_body_is_told_to_be_scanned_whole(tmp_path: Path) -> None:
    points = load_mesh(BODY).vertices
    upper = o3d.utility.Vector3dVector(points[points[:, 2] > 0.8])
    o3d.io.write_point_cloud(str(tmp_path / "upper.ply"), o3d.geometry.PointCloud(upper))
    words = ["--cloud", str(tmp_path / "upper.ply"), "--out", str(tmp_path / "r")]
    done = CliRunner().invoke(fit, words)
    assert isinstance(done.exception, InputError)
    assert "scan the whole person" in str(done.exception)


@pytest.mark.parametrize(
    ("out", "debug", "words"),
    [
        ("r" * 300, None, "cannot be made (File name too long); name another folder with --out"),
        ("r", "r", "which has to be new; name a folder elsewhere with --debug"),
        ("r", "r/pictures", "which has to be new; name a folder elsewhere with --debug"),
    ],
)
def test_a_folder_that_cannot_be_made_is_told_before_the_fit(
    tmp_path: Path, out: str, debug: str | None, words: str
) -> None:
    """A fit was made first, and lost, or "somebody else" had made its folder."""
    body = tmp_path / "body.ply"
    body.write_text("no cloud, which a fit would tell")
    options = [] if debug is None else ["--debug", str(tmp_path / debug)]
    done = CliRunner().invoke(fit, ["--cloud", str(body), "--out", str(tmp_path / out), *options])
    assert isinstance(done.exception, InputError)
    assert words in str(done.exception)
    assert list(tmp_path.iterdir()) == [body]
