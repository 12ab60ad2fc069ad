"""Bad input to `reconstruct fit`: a clear line, an exit code, nothing half written."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from station.simulation.scene import Mesh, chair, load_mesh
from station.simulation.sensor import SimulatedBooth, render_bundle

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def _fit(bundle: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "workers.cli", "fit", str(bundle), "--out", str(out), *options],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_an_empty_booth_is_an_error(tmp_path: Path) -> None:
    folder = render_bundle(None, tmp_path / "empty", frames=3)
    done = _fit(folder, tmp_path / "out", "--quiet")
    assert done.returncode == 1
    assert done.stderr.startswith("error: the booth is empty")
    assert not (tmp_path / "out").exists()


def test_a_torn_frame_is_named(bundle: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn"
    shutil.copytree(bundle, torn)
    path = torn / "depth/back-lower/003.png"
    path.write_bytes(path.read_bytes()[:5000])
    done = _fit(torn, tmp_path / "out", "--quiet")
    assert done.returncode == 1
    assert "back-lower/003.png is torn" in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_unknown_version_is_named(bundle: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(bundle, other)
    manifest = other / "bundle.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "version": 9}))
    done = _fit(other, tmp_path / "out", "--quiet")
    assert done.returncode == 1
    assert "version 9; this program reads 1" in done.stderr


def test_two_people_are_a_rescan(tmp_path: Path) -> None:
    first, second = load_mesh(BODIES / "ann.npz"), load_mesh(BODIES / "cleo.npz")
    beside = Mesh(second.vertices * 0.9 + (0.85, 0.25, 0.0), second.faces)
    booth = SimulatedBooth(clutter=[beside], sway_m=0.0)
    narrow = Mesh(first.vertices - (0.25, 0.0, 0.0), first.faces)
    folder = render_bundle(narrow, tmp_path / "two", booth, frames=4)
    done = _fit(folder, tmp_path / "out", "--quiet")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["status"] == "rescan"
    assert any("two people" in reason for reason in result["reasons"])


def test_a_chair_is_no_body(tmp_path: Path) -> None:
    booth = SimulatedBooth(clutter=chair((0.0, 0.0)))
    folder = render_bundle(None, tmp_path / "chair", booth, frames=4)
    done = _fit(folder, tmp_path / "out", "--quiet")
    if done.returncode == 0:
        assert json.loads((tmp_path / "out/result.json").read_text())["status"] == "rescan"
    else:
        assert done.stderr.startswith("error: ")


@pytest.mark.parametrize("points", [0, 10])
def test_an_absurd_cloud_is_an_error(tmp_path: Path, points: int) -> None:
    path = tmp_path / "cloud.ply"
    rows = "".join(f"{x} 0 0\n" for x in np.linspace(0, 1, points))
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {points}\nproperty float x\n"
        f"property float y\nproperty float z\nend_header\n{rows}"
    )
    done = subprocess.run(
        [sys.executable, "-m", "workers.cli", "fit", "--cloud", str(path), "--out",
         str(tmp_path / "out"), "--quiet"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "points" in done.stderr
