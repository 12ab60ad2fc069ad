"""Ownership of files: files written by root's commands are given to the booth's user."""

from __future__ import annotations

import os
import pwd
import shutil
from collections.abc import Iterable
from pathlib import Path

USER = "booth"


def is_installed_root() -> bool:
    """Whether root works on a machine that has the booth's user."""
    if os.geteuid() != 0:
        return False
    try:
        pwd.getpwnam(USER)
    except KeyError:
        return False
    return True


def give_to_booth(paths: Iterable[Path]) -> None:
    """Give files and folders, with their contents, to the booth's user; needs root."""
    if not is_installed_root():
        return
    for path in paths:
        for place in (path, *(path.rglob("*") if path.is_dir() else ())):
            shutil.chown(place, USER, USER)
