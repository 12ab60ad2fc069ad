"""Arrays derived from the model, kept in the user's cache folder and rebuilt when torn."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
import platformdirs
from numpy.typing import NDArray

FOLDER_VARIABLE = "BOOTH_CACHE"


def cache_folder() -> Path:
    """$BOOTH_CACHE, or the user's cache folder on this system."""
    chosen = os.environ.get(FOLDER_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("body-booth")


def cached_array(key: str, build: Callable[[], NDArray[np.float32]]) -> NDArray[np.float32]:
    """The array kept under a key, or a new one; a cache that cannot be written is done without.

    A file appears whole by rename; its length tells a torn one (a full disk, a copied folder).
    """
    path = cache_folder() / f"{key}.npy"
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        array = np.ascontiguousarray(build())
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.tmp")
        with temporary.open("wb") as stream:
            np.save(stream, array, allow_pickle=False)
        temporary.replace(path)
    except OSError:
        pass
    return array
