"""Import rules and sizes, read from the code, and what a started process really loads."""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PURE = (
    "station/booth/frameset.py",
    "station/booth/session.py",
    "station/sensors/clock.py",
    "station/core/geometry.py",
    "station/core/lens.py",
)
PURE_FOLDERS = (
    "station/core/depth",
    "station/calibration/detect",
    "station/calibration/adjust",
    "station/calibration/solve",
    "workers/cloud",
    "workers/scape",
    "workers/measure",
)
OPEN3D = ("workers/", "station/simulation/")
MAX_MODULES = 14
MAX_MODULE_LINES, MAX_FUNCTION_LINES = 350, 60


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


def test_workers_import_the_core_of_the_station_alone() -> None:
    """A bundle must be reconstructable on a machine that has no booth."""
    offenders = [
        (path, module)
        for path in _sources("workers")
        for module in _imports(path)
        if _under(module, ("station",))
        and module not in ("station", "station.version")
        and not _under(module, ("station.core",))
    ]
    assert offenders == []


def test_the_fit_never_imports_the_learning() -> None:
    """Learning the model needs torch and a database; a booth has neither."""
    offenders = [
        (path, module)
        for path in _sources("station", "workers")
        if not path.is_relative_to(ROOT / "workers/scape/learn")
        for module in _imports(path)
        if _under(module, ("workers.scape.learn",))
    ]
    assert offenders == []


def test_nothing_imports_the_simulation() -> None:
    """The product must not depend on its own test bench; drivers are found by entry points."""
    offenders = [
        (path, module)
        for path in _sources("station", "workers")
        if not path.is_relative_to(ROOT / "station/simulation")
        for module in _imports(path)
        if _under(module, ("station.simulation",))
    ]
    assert offenders == []


def test_folders_import_each_other_in_one_direction() -> None:
    """A circle of folders has no bottom: a stranger finds no place to begin reading."""
    arrows: dict[str, set[str]] = {}
    for path in _sources("station", "workers"):
        folder = str(path.parent.relative_to(ROOT)).replace("/", ".")
        for module in _imports(path):
            target = ROOT / module.replace(".", "/")
            if (
                target.with_suffix(".py").exists()
                and (other := module.rpartition(".")[0]) != folder
            ):
                arrows.setdefault(folder, set()).add(other)
    TopologicalSorter(arrows).prepare()


def test_no_folder_is_too_wide_to_find_a_module_in() -> None:
    folders = Counter(path.parent for path in _sources("station", "workers"))
    wide = {
        str(folder): count
        for folder, count in folders.items()
        if count > MAX_MODULES + (folder / "__init__.py").exists()
    }
    assert wide == {}


def test_nothing_is_too_long_to_be_read_at_once() -> None:
    long = []
    for path in _sources("station", "workers"):
        text = path.read_text()
        if (lines := len(text.splitlines())) > MAX_MODULE_LINES:
            long.append((path, lines))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                long += [(path / node.name, lines)] if lines > MAX_FUNCTION_LINES else []
    assert long == []


def test_every_package_says_what_belongs_there() -> None:
    packages = [path for path in _sources("station", "workers") if path.name == "__init__.py"]
    assert len(packages) > 20
    silent = [path for path in packages if not ast.get_docstring(ast.parse(path.read_text()))]
    assert silent == []


def test_nothing_changes_the_mask_of_new_files() -> None:
    # It belongs to every thread of a process, and two that set and restore it leave the wrong one.
    assert [path for path in _sources("station", "workers") if "umask(" in path.read_text()] == []


def test_mathematics_opens_no_sockets() -> None:
    pure = [ROOT / name for name in PURE]
    pure += _sources(*PURE_FOLDERS)
    offenders = [
        (path, module)
        for path in pure
        for module in _imports(path)
        if _under(module, ("zmq", "socket", "station.messaging.transport"))
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


@pytest.mark.parametrize(
    "module",
    ["station.booth.capture", "station.cli", "station.console.server", "workers.cli"],
)
def test_a_light_process_stays_light(module: str) -> None:
    """open3d is 0.5 s and 230 MB: four capture processes cannot each carry it, and the console is
    back within seconds."""
    program = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"open3d", "scipy.sparse", "trimesh", "torch", "numba"} & set(loaded)
