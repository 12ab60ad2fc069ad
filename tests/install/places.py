"""Folders of these tests, and what the package says of itself."""

from __future__ import annotations

import os
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
WORK = Path(os.environ.get("BOOTH_TEST_INSTALL", ROOT / "build/test-install"))
"""Kept between two calls: the Debian root, packages, compiled dependencies."""
DEBIAN = WORK / "debian"


def dependencies_of_package() -> list[str]:
    """Names of the Debian packages that the booth's package depends on."""
    control = (ROOT / "deploy/package/body-booth/control").read_text()
    (depends,) = re.findall(r"^Depends: (.*)$", control, re.MULTILINE)
    return [re.split(r"[ (|]", entry.strip())[0] for entry in depends.split(",")]
