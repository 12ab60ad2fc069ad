"""The booth's programs: sensors, clocks, framesets, calibration, scans, the operator's commands."""

import os
import time

__version__ = "0.1.0"
_ARCHIVED = "$Format:%ct %H$"
"""Time (seconds since 1970) and name of the commit, in what `git archive` has made."""


def version_of_commit(seconds: int, name: str) -> str:
    """Version of a commit; those of later ones sort after those of earlier ones."""
    stamp = time.strftime("%Y%m%d.%H%M%S", time.gmtime(seconds))
    return f"{__version__}+git{stamp}.{name[:7]}"


def version() -> str:
    """Version of these programs, with the commit that they are of where that is known."""
    commit = _checked_out() if _ARCHIVED.startswith("$") else _ARCHIVED
    if not commit:
        return __version__
    seconds, name = commit.split()
    return version_of_commit(int(seconds), name)


def _checked_out() -> str:
    """Time and name of the commit of a checkout; empty where there is none."""
    # Few commands ask for it.
    import subprocess

    place = os.path.join(os.path.dirname(os.path.dirname(__file__)), ".git")
    if not os.path.exists(place):
        return ""
    # What a hook of another repository sets names that one; what users set changes `git log`.
    command = ["git", f"--git-dir={place}", "rev-list", "--timestamp", "--max-count=1", "HEAD"]
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        told = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return told.stdout.strip()
