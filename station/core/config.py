"""The sections of booth.toml: what a booth consists of, with defaults and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, SerializeAsAny, model_validator

from station.core.drivers import CameraConfig, ConfigPath, Name, Strict
from station.core.errors import ConfigError

_SMALLEST_BALL_M = 0.07
"""Seven of eight are found at 2.6 m; of 60 mm balls three, of 50 mm balls none beyond 2.4 m."""


SHORTEST_WAVING_S = 16.0
"""Waving in which every camera sees the ball often enough for a calibration. 60 times are needed;
the fewest in eight virtual booths were 97, and 46 in 12 s."""


def _radius(radius_m: float) -> float:
    if radius_m < _SMALLEST_BALL_M:
        raise ValueError(
            f"a ball of less than {_SMALLEST_BALL_M:g} m in radius is not found reliably beyond "
            "2.4 m, so front and back cameras rarely see it together: use a larger one"
        )
    # No diameter of a ball that is large enough can pass for a radius.
    if radius_m >= 2.0 * _SMALLEST_BALL_M:
        raise ValueError(
            f"must be below {2.0 * _SMALLEST_BALL_M:g} m: give the ball's radius, which is half "
            "its diameter, in metres"
        )
    return radius_m


def _waving(seconds: float) -> float:
    if seconds < SHORTEST_WAVING_S:
        raise ValueError(
            f"must be at least {SHORTEST_WAVING_S:g} s: in less, not every camera sees the ball as "
            "often as a calibration needs"
        )
    return seconds


def _host_name(name: str) -> str:
    """A name as browsers and certificates have it: letters beyond ASCII are encoded (IDNA)."""
    try:
        return name.encode("idna").decode("ascii")
    except UnicodeError:
        raise ValueError(f"{name!r} is no name by which a computer can be reached") from None


_AS_A_LIST = Field(strict=False)
"""TOML writes a tuple as a list."""
_Value = TypeVar("_Value")
Several = Annotated[tuple[_Value, ...], _AS_A_LIST]
Metres3 = Annotated[tuple[float, float, float], _AS_A_LIST]


class Volume(Strict):
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


class SyncConfig(Strict):
    """Matching of the cameras' frames."""

    tolerance_s: float = Field(default=0.025, gt=0.0, le=0.5, description="a set's widest spread")
    silent_after_s: float = Field(
        default=1.0,
        gt=0.0,
        le=60.0,
        description="a camera that sends no frames for this long is reported",
    )
    live_hz: float = Field(default=3.0, gt=0.0, le=30.0, description="rate of the live cloud")


class ScanConfig(Strict):
    """Length of one scan."""

    framesets: int = Field(default=10, ge=1, le=100)
    max_duration_s: float = Field(
        default=3.0, gt=0.0, le=30.0, description="a scan fails if its framesets take longer"
    )


class CalibrateConfig(Strict):
    """Calibration of the booth."""

    folder: ConfigPath = Field(default=Path("calibrations"), description="all dated calibrations")
    ball_radius_m: Annotated[float, AfterValidator(_radius)] = 0.1
    reference: str = Field(
        default="", description="the camera whose frame the others are solved in first"
    )
    front: Several[str] = Field(
        default=(), description="the cameras that face the person; default: named front..."
    )
    waving_s: Annotated[float, AfterValidator(_waving)] = Field(
        default=60.0, le=600.0, description="how long to wave the ball"
    )
    height_limit_m: float = Field(
        default=0.006,
        gt=0.0,
        le=0.1,
        description="a calibration is refused whose own error of a height may exceed this (95 %)",
    )
    girth_limit_m: float = Field(
        default=0.008,
        gt=0.0,
        le=0.1,
        description="the same of a girth",
    )
    countdown_s: float = Field(
        default=8.0,
        ge=0.0,
        le=60.0,
        description="to walk into the booth, lay the ball down and step back; half for a walk",
    )


class DriftConfig(Strict):
    """Whether cameras still stand where they were calibrated."""

    refuse_scans: bool = Field(
        default=True,
        description="a scan is refused when its background says that a camera moved, and corrected "
        "where depths changed; otherwise the background is not looked at",
    )


class SpoolConfig(Strict):
    """Folder of scans and results, on one local file system (it needs file locks and renames)."""

    folder: ConfigPath = Path("spool")
    min_free_mb: float = Field(default=500.0, ge=0.0, description="a scan is refused below this")


class WorkersConfig(Strict):
    """The reconstruction workers."""

    count: int = Field(default=1, ge=0, le=64)
    method: Literal["joint", "paper"] = "joint"
    timeout_s: float = Field(
        default=120.0, gt=0.0, le=3600.0, description="a job that takes longer is stopped"
    )
    retries: int = Field(
        default=2, ge=0, le=10, description="further attempts after the first failure"
    )


class RetentionConfig(Strict):
    """Body scans are personal data: how long they are kept, days."""

    raw_days: float = Field(default=7.0, ge=0.0, description="bundles of delivered scans")
    result_days: float = Field(default=30.0, ge=0.0, description="results and failed scans")


class ConsoleConfig(Strict):
    """The operator's page and the API."""

    enabled: bool = Field(default=True, description="whether the station runs a console")
    host: str = Field(default="127.0.0.1", description="address to listen at; 0.0.0.0 for all")
    port: int = Field(default=8420, ge=1, le=65535)
    names: Several[Annotated[str, AfterValidator(_host_name)]] = Field(
        default=(), description="names by which browsers reach it, besides the host's own"
    )
    folder: ConfigPath = Field(default=Path("console"), description="password, tokens, log")
    language: Literal["en", "zh"] = "en"
    unit: Literal["cm", "in"] = "cm"
    countdown_s: int = Field(
        default=3, ge=0, le=30, description="countdown before a scan, for the person"
    )
    preview_hz: float = Field(
        default=8.0, gt=0.0, le=10.0, description="rate of the depth pictures"
    )
    session_hours: float = Field(
        default=12.0, gt=0.0, le=720.0, description="how long a login stays valid"
    )
    recordings: ConfigPath | None = Field(
        default=None, description="calibrate from DIR/<step>/<camera> (training, demonstrations)"
    )


class DeliverConfig(Strict):
    """Another program that gets every result: a folder, or a webhook."""

    name: Name = Field(description="its name in the status")
    folder: ConfigPath | None = Field(default=None, description="results are copied into it")
    url: str | None = Field(default=None, description="results are announced to it by POST")
    secret_file: ConfigPath | None = Field(
        default=None, description="holds the key that signs what is posted (HMAC-SHA256)"
    )
    link: str = Field(default="", description="where that program reaches the console: https://...")
    rescans: bool = Field(default=False, description="also results whose verdict is rescan")

    @model_validator(mode="after")
    def _has_one_target(self) -> Self:
        if (self.folder is None) == (self.url is None):
            raise ValueError(f"deliver {self.name}: give either folder or url")
        if self.url is not None and not self.url.startswith(("http://", "https://")):
            raise ValueError(f"deliver {self.name}: the url must begin with https:// or http://")
        if self.url is not None and self.secret_file is None:
            raise ValueError(
                f"deliver {self.name}: a url needs secret_file, the key that signs what is posted"
            )
        return self


class RuntimeConfig(Strict):
    """Sockets and logs."""

    folder: ConfigPath = Field(
        default=Path("run"), description="ipc sockets, created with mode 0700"
    )
    command_timeout_s: float = Field(default=5.0, gt=0.0, le=60.0)


def _section() -> Any:
    """A section that may be left out: its defaults are validated too, so paths are resolved."""
    return Field(default_factory=dict)


class MetricsConfig(Strict):
    """Prometheus metrics, for this machine alone."""

    port: int = Field(default=0, ge=0, le=65535, description="on 127.0.0.1; 0: none are served")


class BoothConfig(Strict):
    """A whole booth."""

    version: Literal[1] = 1
    name: str = Field(default="", max_length=60, description="the booth's name, in every result")
    cameras: Several[SerializeAsAny[CameraConfig]] = Field(min_length=1)
    calibration: ConfigPath = Path("calibration.json")
    volume: Volume = _section()
    sync: SyncConfig = _section()
    scan: ScanConfig = _section()
    calibrate: CalibrateConfig = _section()
    drift: DriftConfig = _section()
    spool: SpoolConfig = _section()
    workers: WorkersConfig = _section()
    retention: RetentionConfig = _section()
    runtime: RuntimeConfig = _section()
    console: ConsoleConfig = _section()
    deliver: Several[DeliverConfig] = ()
    metrics: MetricsConfig = _section()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [camera.name for camera in self.cameras]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"the camera name {twice[0]} is used twice")
        targets = [target.name for target in self.deliver]
        if len(set(targets)) < len(targets):
            raise ValueError("each [[deliver]] needs a name of its own")
        named = (*self.calibrate.front, *filter(None, [self.calibrate.reference]))
        for name in named:
            if name not in names:
                raise ValueError(f"calibrate names {name}, which is not a camera of this booth")
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

    @property
    def recorded(self) -> frozenset[str]:
        """The cameras that play recordings."""
        return frozenset(camera.name for camera in self.cameras if camera.replays)

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
