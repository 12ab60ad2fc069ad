"""Who may import whom: read from the code, and from what a started process really loads."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STATION_FOR_WORKERS = (
    "station.errors",
    "station.files",
    "station.geometry",
    "station.config",
    "station.messages",
    "station.bundle",
    "station.spool",
    "station.depth",
    "station.calibration.rig",
    "station.calibration.drift",
    "station.lazy_group",
    "station.service",
    "station",
)
PURE = ("station/frameset.py", "station/session.py", "station/clock.py", "station/geometry.py")
OPEN3D = ("workers/", "station/drivers/virtual")


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""
            if node.module in ("station", "workers"):
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _sources(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def _under(module: str, names: tuple[str, ...]) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in names)


def test_station_never_imports_workers() -> None:
    offenders = [
        path
        for path in _sources("station")
        if any(_under(module, ("workers",)) for module in _imports(path))
    ]
    assert offenders == []


def test_workers_import_little_of_the_station() -> None:
    """A bundle must be reconstructable on a machine that has no booth."""
    offenders = [
        (path, module)
        for path in _sources("workers")
        for module in _imports(path)
        if _under(module, ("station",))
        and not (module == "station" or _under(module, STATION_FOR_WORKERS[:-1]))
        and module != "station.__version__"
    ]
    assert offenders == []


def test_mathematics_opens_no_sockets() -> None:
    pure = [ROOT / name for name in PURE]
    pure += _sources("workers/scape", "workers/measure", "station/depth")
    offenders = [
        (path, module)
        for path in pure
        if path.exists()
        for module in _imports(path)
        if _under(module, ("zmq", "socket", "station.transport"))
    ]
    assert offenders == []


def test_open3d_stays_out_of_the_capture_processes() -> None:
    offenders = [
        path
        for path in _sources("station", "workers")
        if not str(path.relative_to(ROOT)).startswith(OPEN3D)
        and any(_under(module, ("open3d",)) for module in _imports(path))
    ]
    assert offenders == []


@pytest.mark.parametrize("module", ["station.capture", "station.cli", "workers.cli"])
def test_a_light_process_stays_light(module: str) -> None:
    """open3d is 0.5 s and 230 MB: four capture processes cannot each carry it."""
    program = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"open3d", "scipy.sparse", "trimesh", "torch", "numba"} & set(loaded)
