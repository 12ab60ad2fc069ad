"""Arrays derived from the model, kept in the user's cache folder and rebuilt when torn."""

from __future__ import annotations

import os
import uuid
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

FOLDER_VARIABLE = "BOOTH_CACHE"


def cache_folder() -> Path:
    """$BOOTH_CACHE, or the user's cache folder on this system."""
    chosen = os.environ.get(FOLDER_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("body-booth")


def cached_arrays(key: str, build: Callable[[], Arrays]) -> Arrays:
    """The arrays kept under a key, or new ones; a cache that cannot be written is done without.

    A file appears whole by rename; its checksums tell a torn one (a full disk, a copied folder).
    """
    path = cache_folder() / f"{key}.npz"
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        arrays = {name: np.ascontiguousarray(array) for name, array in build().items()}
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.tmp")
        with temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        temporary.replace(path)
    except OSError:
        pass  # a folder that takes no files costs time at the next start, not this result
    return arrays
