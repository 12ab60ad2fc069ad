"""Workers that hang or meet a bad bundle: the scan ends in failed/ with its reason."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from station.core.spool import REASON, Spool

_CAMERA = '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'


def _serve_until_failed(folder: Path, scan_id: str, workers: str) -> str:
    """Run `reconstruct work` until the scan has failed; returns the reason."""
    (folder / "booth.toml").write_text(f"{_CAMERA}[workers]\n{workers}\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "workers.cli", "work", "--config", str(folder / "booth.toml")]
    )
    reason = folder / "spool/failed" / scan_id / REASON
    try:
        deadline_s = time.monotonic() + 60.0
        while not reason.exists():
            assert time.monotonic() < deadline_s
            assert process.poll() is None
            time.sleep(0.1)
    finally:
        process.terminate()
        process.wait(timeout=20)
    return str(json.loads(reason.read_text())["reason"])


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "spool")


def test_a_hung_job_is_killed_and_tried_again(spool: Spool, bundle: Path, tmp_path: Path) -> None:
    temporary = spool.temporary("slow")
    shutil.copytree(bundle, temporary)
    spool.submit(temporary, "slow")
    reason = _serve_until_failed(tmp_path, "slow", "timeout_s = 0.02\nretries = 1")
    assert "hung" in reason
    assert not list((tmp_path / "spool/outbox").iterdir())


def test_a_bad_bundle_fails_once_with_its_reason(
    spool: Spool, bundle: Path, tmp_path: Path
) -> None:
    temporary = spool.temporary("torn")
    shutil.copytree(bundle, temporary)
    (temporary / "depth/front-lower/000.png").write_bytes(b"\x89PNG")
    spool.submit(temporary, "torn")
    reason = _serve_until_failed(tmp_path, "torn", "retries = 2")
    assert "000.png is torn" in reason
    assert (tmp_path / "spool/failed/torn/bundle.json").exists()


def test_old_scans_are_removed_and_new_ones_kept(spool: Spool) -> None:
    from station.booth.retention import expire_old
    from station.core.config import RetentionConfig

    for state in ("done", "outbox", "queue"):
        spool.path(state, "a").mkdir()
    day_s = 86_400.0
    removed = expire_old(spool, RetentionConfig(raw_days=2, result_days=9), time.time() + 3 * day_s)
    assert removed == [spool.path("done", "a")]
    removed = expire_old(spool, RetentionConfig(), time.time() + 99 * day_s)
    assert removed == [spool.path("outbox", "a")]
    assert spool.path("queue", "a").exists()
