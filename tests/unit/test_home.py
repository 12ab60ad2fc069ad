"""A service whose user has no home, or one that takes no files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_PROGRAM = """
import os
from pathlib import Path
from station.core import service
service._CODE = Path("/nonexistent")
service.set_up_caches()
import workers.cloud.points
import station.booth.sync
print(os.environ["NUMBA_CACHE_DIR"])
"""


def test_sync_and_workers_start_without_a_writable_home(tmp_path: Path) -> None:
    """Numba raised at the import: it had no place for what it compiles."""
    kept = {
        key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "NUMBA"))
    }
    kept.pop("BOOTH_CACHE", None)
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env={**kept, "HOME": "/proc/nowhere", "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(tmp_path)
