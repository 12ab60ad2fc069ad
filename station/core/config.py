"""booth.toml: what a booth consists of. An unknown or impossible value is an error naming its key.

Relative paths are relative to the folder of the configuration file.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from station.core.errors import ConfigError

DEFAULT_PATH = Path("booth.toml")
ENVIRONMENT_VARIABLE = "BOOTH_CONFIG"


def _plain_name(name: str) -> str:
    if not name or not all(c.isalnum() or c in "-_" for c in name) or not name.isascii():
        raise ValueError("use letters, digits, '-' and '_' only")
    return name


_SMALLEST_BALL_M = 0.07
"""Seven of eight are found at 2.6 m; of 60 mm balls three, of 50 mm balls none beyond 2.4 m."""


def _found_afar(radius_m: float) -> float:
    if radius_m < _SMALLEST_BALL_M:
        raise ValueError(
            f"a ball of less than {_SMALLEST_BALL_M:g} m in radius is lost from 2.4 m on, so that "
            "front and back cameras hardly see it together: use a larger one"
        )
    return radius_m


Name = Annotated[str, AfterValidator(_plain_name)]
Metres3 = tuple[float, float, float]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CameraConfig(_Strict):
    """One sensor and the driver that reads it."""

    name: Name = Field(description="the camera's name in the calibration and in every message")
    driver: Literal["freenect", "recorded", "virtual"] = Field(description="how it is read")
    serial: str = Field(default="", description="the sensor's serial number (freenect)")
    recording: Path | None = Field(
        default=None,
        description="a recording folder (INDEX.txt): replayed through libfreenect's replay "
        "library (freenect) or read without it (recorded)",
    )
    body: Path | None = Field(default=None, description="the virtual person's mesh (virtual)")
    seed: int = Field(default=0, ge=0, description="of the simulated noise and clock (virtual)")

    @model_validator(mode="after")
    def _has_a_source(self) -> Self:
        if self.driver == "recorded" and self.recording is None:
            raise ValueError(f"camera {self.name}: driver recorded needs the key recording")
        if self.driver == "freenect" and not self.serial and self.recording is None:
            raise ValueError(f"camera {self.name}: driver freenect needs serial or recording")
        if self.driver == "virtual" and self.body is None:
            raise ValueError(f"camera {self.name}: driver virtual needs the key body")
        return self


class VolumeConfig(_Strict):
    """The part of the world in which a body is looked for, metres."""

    min_m: Metres3 = (-0.95, -0.75, 0.0)
    max_m: Metres3 = (0.95, 0.75, 2.2)
    floor_clearance_m: float = Field(
        default=0.012, ge=0.0, le=0.1, description="points lower than this are floor"
    )

    @model_validator(mode="after")
    def _has_content(self) -> Self:
        if any(high <= low for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("max_m must exceed min_m on every axis")
        return self


class SyncConfig(_Strict):
    """How frames of the cameras are matched."""

    tolerance_s: float = Field(default=0.025, gt=0.0, le=0.5, description="a set's widest spread")
    silent_after_s: float = Field(
        default=1.0, gt=0.0, le=60.0, description="a camera without frames this long is named"
    )
    live_hz: float = Field(default=3.0, gt=0.0, le=30.0, description="rate of the live cloud")


class ScanConfig(_Strict):
    """What one scan takes."""

    framesets: int = Field(default=10, ge=1, le=100)
    max_duration_s: float = Field(
        default=3.0, gt=0.0, le=30.0, description="all framesets within this time, or it fails"
    )


class CalibrateConfig(_Strict):
    """How the booth is calibrated."""

    folder: Path = Field(default=Path("calibrations"), description="all dated calibrations")
    ball_radius_m: Annotated[float, AfterValidator(_found_afar)] = Field(default=0.1, le=0.3)
    reference: str = Field(default="", description="the camera that the others are tied to first")
    front: tuple[str, ...] = Field(
        default=(), description="the cameras that face the person; default: named front..."
    )
    waving_s: float = Field(
        default=60.0, ge=10.0, le=600.0, description="how long to wave the ball"
    )
    countdown_s: float = Field(
        default=8.0, ge=0.0, le=60.0, description="to walk into the booth, or out of it"
    )


class DriftConfig(_Strict):
    """Whether cameras still stand where they were calibrated."""

    refuse_scans: bool = Field(
        default=True, description="a scan is refused when its background says that a camera moved"
    )


class SpoolConfig(_Strict):
    """Where scans and results lie; one local file system (file locks and renames)."""

    folder: Path = Path("spool")
    min_free_mb: float = Field(default=500.0, ge=0.0, description="a scan is refused below this")


class WorkersConfig(_Strict):
    """The reconstruction workers."""

    count: int = Field(default=1, ge=0, le=64)
    method: Literal["joint", "paper"] = "joint"
    timeout_s: float = Field(default=120.0, gt=0.0, le=3600.0, description="a job hangs after this")
    retries: int = Field(default=2, ge=0, le=10, description="tries after the first failure")


class RetentionConfig(_Strict):
    """Body scans are personal data: how long they are kept, days."""

    raw_days: float = Field(default=7.0, ge=0.0, description="bundles of delivered scans")
    result_days: float = Field(default=30.0, ge=0.0, description="results and failed scans")


class RuntimeConfig(_Strict):
    """Sockets and logs."""

    folder: Path = Field(default=Path("run"), description="ipc sockets, created with mode 0700")
    command_timeout_s: float = Field(default=5.0, gt=0.0, le=60.0)


class BoothConfig(_Strict):
    """A whole booth."""

    version: Literal[1] = 1
    cameras: tuple[CameraConfig, ...] = Field(min_length=1)
    calibration: Path = Path("calibration.json")
    volume: VolumeConfig = VolumeConfig()
    sync: SyncConfig = SyncConfig()
    scan: ScanConfig = ScanConfig()
    calibrate: CalibrateConfig = CalibrateConfig()
    drift: DriftConfig = DriftConfig()
    spool: SpoolConfig = SpoolConfig()
    workers: WorkersConfig = WorkersConfig()
    retention: RetentionConfig = RetentionConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [camera.name for camera in self.cameras]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"the camera name {twice[0]} is used twice")
        named = (*self.calibrate.front, *filter(None, [self.calibrate.reference]))
        for name in named:
            if name not in names:
                raise ValueError(f"calibrate names {name}, which is not a camera here")
        return self

    @property
    def reference(self) -> str:
        """The camera that the others are tied to first."""
        return self.calibrate.reference or (self.front_cameras or (self.cameras[0].name,))[-1]

    @property
    def front_cameras(self) -> tuple[str, ...]:
        """The cameras that face the person."""
        names = tuple(camera.name for camera in self.cameras)
        return self.calibrate.front or tuple(n for n in names if n.startswith("front"))

    def camera(self, name: str) -> CameraConfig:
        """A camera's section.

        Raises:
            ConfigError: naming the camera and those that there are.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras)
        raise ConfigError(f"camera {name} is not in the configuration (it has: {known})")


def find_config(path: Path | None) -> Path:
    """The configuration file to use: the one given, $BOOTH_CONFIG, or ./booth.toml."""
    if path is not None:
        return path
    return Path(os.environ.get(ENVIRONMENT_VARIABLE, DEFAULT_PATH))


def load_config(path: Path) -> BoothConfig:
    """Read booth.toml with its paths made absolute.

    Raises:
        ConfigError: naming the file, the key and what is allowed.
    """
    try:
        document = tomllib.loads(path.read_text())
    except OSError as cause:
        raise ConfigError(
            f"{path} cannot be read ({cause.strerror}); copy deploy/booth.example.toml there "
            "or name another file with --config"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise ConfigError(f"{path} is not TOML: {cause}") from None
    try:
        config = BoothConfig.model_validate(document)
    except ValidationError as cause:
        raise ConfigError(f"{path}: {_first_problem(cause)}") from None
    return _with_absolute_paths(config, path.resolve().parent)


def _first_problem(cause: ValidationError) -> str:
    """One line for the first error: the key, what is wrong, what is allowed."""
    problem = cause.errors()[0]
    key = ".".join(str(part) for part in problem["loc"]) or "the file"
    if problem["type"] == "extra_forbidden":
        model: Any = BoothConfig
        for part in problem["loc"][:-1]:
            if isinstance(part, str):
                model = _section(model, part)
        allowed = ", ".join(model.model_fields)
        return f"unknown key {key}; allowed here: {allowed}"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{key}: {message} (found {problem['input']!r:.80})"


def _section(model: Any, key: str) -> Any:
    """The model of a nested section, also of one in a tuple (cameras)."""
    annotation: Any = model.model_fields[key].annotation
    return next(iter(getattr(annotation, "__args__", ())), annotation)


def _with_absolute_paths(config: BoothConfig, base: Path) -> BoothConfig:
    cameras = tuple(
        camera.model_copy(
            update={
                key: base / value
                for key in ("recording", "body")
                if (value := getattr(camera, key)) is not None
            }
        )
        for camera in config.cameras
    )
    return config.model_copy(
        update={
            "cameras": cameras,
            "calibration": base / config.calibration,
            "calibrate": config.calibrate.model_copy(
                update={"folder": base / config.calibrate.folder}
            ),
            "spool": config.spool.model_copy(update={"folder": base / config.spool.folder}),
            "runtime": config.runtime.model_copy(update={"folder": base / config.runtime.folder}),
        }
    )
