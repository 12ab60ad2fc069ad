"""The cameras' sections of booth.toml, and how the driver that each one names is found.

A driver is a class that reads one kind of sensor (`station.sensors.base.DepthDriver`). Its package
declares it in the entry point group `body_booth.drivers`; the entry point's name is what stands
under `driver` in booth.toml. Its attribute `Config` is the class of its section there, a subclass
of `CameraConfig`. No other place lists the drivers.
"""

from __future__ import annotations

import re
import unicodedata
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

from station.core.errors import ConfigError

ENTRY_POINTS = "body_booth.drivers"
BASE_FOLDER = "base_folder"
"""Key of the validation context: the folder that relative paths are relative to."""


_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,39}")
"""A name is a word of commands, where "-x" would be an option, and a part of sockets' file names,
which have at most 107 characters."""


def plain_name(name: str) -> str:
    """The name, if a camera may have it.

    Raises:
        ValueError: what is allowed.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            "use 1 to 40 letters, digits, '-' and '_' for a name, which does not begin with '-'"
        )
    return name


def _beside_the_file(path: Path, info: ValidationInfo) -> Path:
    # Such as a tab or an escape; spaces of all scripts are no such characters.
    if any(unicodedata.category(letter) == "Cc" for letter in str(path)):
        raise ValueError("must be a path without control characters: write '...', not \"...\\...\"")
    base = (info.context or {}).get(BASE_FOLDER)
    return path if base is None else base / path


Name = Annotated[str, AfterValidator(plain_name)]
ConfigPath = Annotated[Path, Field(strict=False), AfterValidator(_beside_the_file)]
"""A path in the configuration: a relative one is relative to the configuration file."""


class Strict(BaseModel):
    """A section of the configuration: unknown keys and impossible values are errors.

    So is a value of another type: "0.15" or true for a number.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, validate_default=True
    )


class CameraConfig(Strict):
    """Keys of every camera's section; each driver adds its own."""

    name: Name = Field(description="the camera's name in the calibration and in every message")
    driver: str = Field(description="how it is read: the name of an installed driver")

    @property
    def replays(self) -> bool:
        """Whether it plays a recording, which no cable leads to."""
        return getattr(self, "recording", None) is not None

    def replaying(self, recording: Path) -> CameraConfig:
        """The section of this camera as it plays a recording instead.

        Raises:
            ConfigError: its driver plays no recordings.
        """
        del recording
        raise ConfigError(
            f"camera {self.name}: the driver {self.driver} cannot play recordings; use a "
            "configuration whose cameras have a driver that can"
        )


def driver_class(name: str) -> Any:
    """The class of a driver by name; only the module in use is imported.

    Raises:
        ConfigError: no such driver is installed, or its package cannot be imported.
    """
    found = list(entry_points(group=ENTRY_POINTS, name=name))
    if not found:
        known = ", ".join(sorted({point.name for point in entry_points(group=ENTRY_POINTS)}))
        raise ConfigError(
            f"there is no driver {name!r}; installed: {known or 'none; reinstall body-booth'}"
        )
    try:
        return found[0].load()
    except (ImportError, AttributeError) as cause:
        raise ConfigError(
            f"the driver {name} ({found[0].value}) cannot be loaded ({cause}); "
            "reinstall its package"
        ) from None


class AnyCamera(CameraConfig):
    """A section of which only the common keys are checked."""

    model_config = ConfigDict(extra="ignore")

    def of_its_driver(self) -> type[CameraConfig]:
        """The class that the whole section is checked by."""
        found: type[CameraConfig] = driver_class(self.driver).Config
        return found
