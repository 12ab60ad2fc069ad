"""Body model, and a virtual booth with a person unknown to it, which many tests share."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from running_station import STATION, Station
from xdist.scheduler import LoadFileScheduling

from station.core.config import BoothConfig
from station.core.config_file import load_config

if TYPE_CHECKING:
    from workers.scape.model.body_model import BodyModel

BODIES = Path(__file__).parents[1] / "station/simulation/bodies"

_OF_ONE_STATION = (
    "api", "attacks", "crooked_requests", "exports",
    "page", "page_booth", "page_results", "page_views", "security",
)  # fmt: skip
_TOGETHER = (
    [f"tests/accuracy/test_{name}.py" for name in ("bars", "model_accuracy", "unlike")],
    [f"tests/console/test_{name}.py" for name in _OF_ONE_STATION],
)
"""Files that share what takes half a minute to make: the database of bodies; a station's scans."""

_ONE_CAMERA = """
[[cameras]]
name = "front-lower"
driver = "recorded"
recording = "front-lower"
[spool]
folder = "spool"
"""


class _Files(LoadFileScheduling):  # type: ignore[misc]  # xdist states no types
    """A process takes whole files, and those that share much together."""

    def _split_scope(self, nodeid: str) -> str:
        path = super()._split_scope(nodeid)
        return next((files[0] for files in _TOGETHER if path in files), path)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> LoadFileScheduling | None:
    return _Files(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.fixture
def one_camera(tmp_path: Path) -> BoothConfig:
    """Configuration of a booth of one camera, without recording and calibration."""
    path = tmp_path / "booth.toml"
    path.write_text(_ONE_CAMERA)
    return load_config(path)


@pytest.fixture(scope="session")
def model() -> BodyModel:
    """The body model, with what is kept of it."""
    from workers.scape.model.body_model import load_model

    return load_model()


@pytest.fixture(scope="session")
def booth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, calibration.json and booth.toml."""
    folder = tmp_path_factory.mktemp("booth")
    options = ("--body", BODIES / "ann.npz", "--out", folder, "--frames", "12", "--passes", "150")
    subprocess.run([*STATION, "record-virtual", *options], check=True, capture_output=True)
    return folder


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan bundle of another body, on an ordinary day."""
    from station.simulation.scene import load_mesh
    from station.simulation.sensor import SimulatedBooth, render_bundle

    folder = tmp_path_factory.mktemp("bundles") / "ben"
    return render_bundle(load_mesh(BODIES / "ben.npz"), folder, SimulatedBooth(seed=4))


@pytest.fixture
def make_station(booth: Path, tmp_path: Path) -> Iterator[Callable[[str], Station]]:
    """Starts stations on the booth's recordings; what is given is added to booth.toml."""
    running: list[Station] = []

    def make(extra: str = "", change: Callable[[str], str] = lambda text: text) -> Station:
        config = tmp_path / "booth.toml"
        text = (booth / "booth.toml").read_text().replace('recording = "', f'recording = "{booth}/')
        if "[console]" not in extra:
            # Several stations at once would all want its port.
            extra += "\n[console]\nenabled = false"
        config.write_text(f'calibration = "{booth}/calibration.json"\n{change(text)}\n{extra}\n')
        running.append(Station(config))
        return running[-1]

    yield make
    for station in running:
        station.close()
