"""Cache of arrays that are derived from the model, in the user's cache folder."""

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
    """$BOOTH_CACHE, or the default cache folder of the system."""
    chosen = os.environ.get(FOLDER_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("body-booth")


def cached_arrays(key: str, build: Callable[[], Arrays]) -> Arrays:
    """Arrays stored under a key; they are built if the file is missing or damaged.

    A file is renamed when it is complete, and its checksums show damage (a full disk, a copied
    folder). Without write permission nothing is stored.
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
        pass  # without a cache the next start takes longer; the result is the same
    return arrays
