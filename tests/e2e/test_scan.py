"""From four replayed Kinects to a body in the outbox, through the real processes."""

import hashlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
from running_station import Station

from station.core.config_file import load_config
from station.core.service import read_health

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def _surface_rms_m(result: Path, body: str) -> float:
    mesh = o3d.io.read_triangle_mesh(str(result / "mesh.ply"))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    truth = np.load(BODIES / f"{body}.npz")["vertices"].astype(np.float32)
    distance = scene.compute_distance(o3d.core.Tensor(truth)).numpy()
    return float(np.sqrt(np.mean(distance**2)))


def test_a_scan_through_libfreenect_is_delivered_whole(
    make_station: Callable[..., Station],
) -> None:
    station = make_station()
    started = station.command("start")
    assert started.returncode == 0, started.stderr
    assert station.command("start").returncode == 0
    done = station.command("scan", "--label", "Order 7", "--scan-id", "20260101T000000Z-0001")
    assert done.returncode in (0, 3), done.stderr + station.log.read_text()
    assert "the person may leave" in done.stdout or "reconstructing" in done.stdout
    result = station.config.parent / "spool/outbox/20260101T000000Z-0001"
    assert str(result) in done.stdout
    document = json.loads((result / "result.json").read_text())
    for name, digest in document["files"].items():
        assert hashlib.sha256((result / name).read_bytes()).hexdigest() == digest
    assert _surface_rms_m(result, "ann") < 0.008
    again = station.command("scan", "--scan-id", "20260101T000000Z-0001")
    assert again.returncode == done.returncode
    spool = station.config.parent / "spool"
    assert [entry.name for entry in (spool / "outbox").iterdir()] == ["20260101T000000Z-0001"]
    bundle = json.loads((spool / "done/20260101T000000Z-0001/bundle.json").read_text())
    assert bundle["label"] == "Order 7"
    assert bundle["sync"]["spread_s_max"] <= 0.025
    assert station.command("stop").returncode == 0
    refused = station.command("scan")
    assert refused.returncode == 1
    assert "station start" in refused.stderr


def test_killed_processes_lose_no_scan(make_station: Callable[..., Station]) -> None:
    """kill -9 of a capture process, of the job mid-fit: the scan is delivered exactly once."""
    station = make_station()
    assert station.command("start").returncode == 0
    victim = station.pids("capture", "back-upper")[0]
    os.kill(victim, signal.SIGKILL)
    station.wait_until(
        lambda: (
            victim not in station.pids("capture", "back-upper")
            and bool(station.pids("capture", "back-upper"))
        ),
        "the capture process is started again",
    )
    assert station.command("start").returncode == 0
    taken = station.command("scan", "--no-wait", "--scan-id", "20260101T000000Z-0002")
    assert taken.returncode == 0, taken.stderr
    spool = station.config.parent / "spool"
    station.wait_until(
        lambda: (spool / "work/20260101T000000Z-0002").exists(), "a worker claims it"
    )
    for pid in station.pids("workers.reconstruct.job_process"):
        os.kill(pid, signal.SIGKILL)
    station.wait_until(
        lambda: (spool / "outbox/20260101T000000Z-0002").exists(), "it is delivered", 120.0
    )
    station.wait_until(lambda: (spool / "done/20260101T000000Z-0002").exists(), "it is put away")
    assert not list((spool / "queue").iterdir())
    assert not list((spool / "work").iterdir())


def test_a_lost_recording_names_the_camera(make_station: Callable[..., Station]) -> None:
    station = make_station(change=lambda text: text.replace("/front-upper", "/nowhere"))
    started = station.command("start", "--timeout", "4")
    assert started.returncode == 1
    assert "camera front-upper" in started.stderr
    assert "nowhere" in started.stderr
    # Told as soon as it is known, not when the time is up.
    assert "trying again" in started.stderr.splitlines()[0]
    refused = station.command("scan")
    assert refused.returncode == 1
    assert "front-upper" in refused.stderr


def test_a_full_disk_refuses_before_the_scan(make_station: Callable[..., Station]) -> None:
    station = make_station("[spool]\nmin_free_mb = 1e9")
    assert station.command("start").returncode == 0
    refused = station.command("scan")
    assert refused.returncode == 1
    assert "MB free" in refused.stderr
    assert not list((station.config.parent / "spool/queue").iterdir())


def test_sync_killed_in_a_scan_is_reported_as_failed(make_station: Callable[..., Station]) -> None:
    """The operator once waited for ever for a scan that nobody was collecting any more."""
    station = make_station("[scan]\nframesets = 60\nmax_duration_s = 3.0\n[workers]\ncount = 0")
    assert station.command("start").returncode == 0
    import threading

    def kill_sync() -> None:
        folder = load_config(station.config).runtime.folder
        station.wait_until(lambda: bool(read_health(folder, "sync").get("collecting")), "it scans")
        os.kill(station.pids("sync")[0], signal.SIGKILL)

    killing = threading.Thread(target=kill_sync)
    killing.start()
    done = station.command("scan")
    killing.join()
    assert done.returncode == 1
    assert "failed" in done.stderr
