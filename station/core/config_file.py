"""Finding and reading booth.toml. An unknown or impossible value is an error naming its key.

Relative paths are relative to the folder of the configuration file.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from station.core.config import BoothConfig
from station.core.drivers import BASE_FOLDER, AnyCamera, CameraConfig, Strict
from station.core.errors import ConfigError

DEFAULT_PATH = Path("booth.toml")
ENVIRONMENT_VARIABLE = "BOOTH_CONFIG"


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
    except PermissionError:
        # Under sudo, an installed booth's commands run as its user.
        raise ConfigError(
            f"{path} may not be read by you; run the command with sudo, or put the file where the "
            "user booth may read it"
        ) from None
    except OSError as cause:
        raise ConfigError(
            f"{path} cannot be read ({cause.strerror}); station setup writes it, --config names "
            "another file"
        ) from None
    except (ValueError, RecursionError) as cause:
        # Python's own words for the others are advice to programmers.
        its_own = isinstance(cause, tomllib.TOMLDecodeError | UnicodeDecodeError)
        said = cause if its_own else "a number or brackets in brackets go on for too long"
        raise ConfigError(
            f"{path} is not TOML: {said}; correct it, or station setup --replace writes a new one"
        ) from None
    base = {BASE_FOLDER: path.resolve().parent}
    try:
        if isinstance(cameras := document.get("cameras"), list):
            document["cameras"] = [
                _camera(section, index, base) for index, section in enumerate(cameras)
            ]
        return _validated(BoothConfig, document, (), base)
    except ConfigError as cause:
        raise ConfigError(f"{path}: {cause}") from None


Section = TypeVar("Section", bound=Strict)
_Place = tuple[str | int, ...]


def _camera(section: Any, index: int, base: dict[str, Path]) -> CameraConfig:
    """A camera's section, checked by the class of its driver."""
    place = ("cameras", index)
    named = _validated(AnyCamera, section, place, base)
    try:
        model = named.of_its_driver()
    except ConfigError as cause:
        raise ConfigError(f"{_key((*place, 'driver'))}: {cause}") from None
    return _validated(model, section, place, base)


def _validated(model: type[Section], document: Any, place: _Place, base: Any) -> Section:
    try:
        return model.model_validate(document, context=base)
    except ValidationError as cause:
        raise ConfigError(_first_problem(cause, model, place)) from None


def _key(place: _Place) -> str:
    return ".".join(str(part) for part in place) or "the file"


def _first_problem(cause: ValidationError, model: type[Strict], place: _Place) -> str:
    """One line for the first error: the key, what is wrong, what is allowed."""
    problem = cause.errors()[0]
    key = _key((*place, *problem["loc"]))
    if problem["type"] == "extra_forbidden":
        at: Any = model
        for part in problem["loc"][:-1]:
            at = at.__args__[0] if isinstance(part, int) else at.model_fields[part].annotation
        return f"unknown key {key}; allowed here: {', '.join(at.model_fields)}"
    if problem["type"] == "missing":
        return f"{key} is missing"
    said = problem["msg"].removeprefix("Value error, ").replace("Tuple should", "Input should")
    said = said.replace("Input should", "must").replace("valid tuple", "list")
    return f"{key}: {said} (found {problem['input']!r:.80})"
