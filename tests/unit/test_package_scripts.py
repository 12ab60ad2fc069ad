"""Scripts of the Debian package, with a systemctl that notes what it is told."""

import os
import subprocess
from pathlib import Path

import pytest

_SCRIPTS = Path(__file__).parents[2] / "deploy/package/body-booth"


@pytest.mark.parametrize("running", [False, True])
@pytest.mark.parametrize("off", ["abort-upgrade", "abort-remove", "abort-deconfigure"])
def test_an_upgrade_that_is_refused_leaves_the_commands(
    tmp_path: Path, off: str, running: bool
) -> None:
    """The commands of a booth that was stopped were missing until the next boot."""
    told, flag = tmp_path / "told", tmp_path / "was-running"
    (tmp_path / "systemctl").write_text(f'#!/bin/sh\necho "$@" >>{told}\n')
    (tmp_path / "systemctl").chmod(0o755)
    if running:
        flag.touch()
    text = (_SCRIPTS / "postinst").read_text().replace("/run/systemd/system", str(tmp_path))
    subprocess.run(
        ["sh", "-c", text.replace("/run/body-booth.was-running", str(flag)), "postinst", off, "1"],
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}, check=True,
    )  # fmt: skip
    started = ["start booth.target"] if running else []
    assert told.read_text().splitlines() == ["--quiet enable --now opt-booth.mount", *started]
    assert not flag.exists()
