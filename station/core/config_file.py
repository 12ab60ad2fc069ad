"""Finding and reading booth.toml. An unknown or impossible value is an error naming its key.

Relative paths are relative to the folder of the configuration file.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from station.core.config import BoothConfig
from station.core.drivers import BASE_FOLDER, AnyCamera, CameraConfig, Strict
from station.core.errors import ConfigError

DEFAULT_PATH = Path("booth.toml")
ENVIRONMENT_VARIABLE = "BOOTH_CONFIG"
_DECIMAL_COMMA = re.compile(r"^ *\w+ *= *[+-]?\d+,\d+", re.MULTILINE)
_MUST = {
    "bool_type": "must be true or false, without quotes",
    "float_type": "must be a number, without quotes",
    "int_type": "must be a whole number, without quotes",
    "model_type": "must be a section with keys of its own",
    "path_type": "must be a path in quotes",
    "string_type": "must be a text in quotes",
    "string_too_long": "must have at most {max_length} characters",
    "too_long": "must have at most {max_length} values",
    "too_short": "must have at least {min_length}",
    "tuple_type": "must be a list in brackets",
}
"""Kind of pydantic's error -> words that need no Python; those of the others do not."""


def find_config(path: Path | None) -> Path:
    """The configuration file to use: the one given, $BOOTH_CONFIG, or ./booth.toml."""
    if path is not None:
        return path
    return Path(os.environ.get(ENVIRONMENT_VARIABLE, DEFAULT_PATH))


def option_for(path: Path) -> str:
    """The option that names a configuration to a command, with a space before it; empty if the
    command finds it itself."""
    return "" if find_config(None).resolve() == path else f" --config {shlex.quote(str(path))}"


def load_config(path: Path) -> BoothConfig:
    """Read booth.toml with its paths made absolute.

    Raises:
        ConfigError: naming the file, the key and what is allowed.
    """
    document = _document(path)
    base = {BASE_FOLDER: path.resolve().parent}
    try:
        if isinstance(cameras := document.get("cameras"), list):
            document["cameras"] = [
                _camera(section, index, base) for index, section in enumerate(cameras)
            ]
        return _validated(BoothConfig, document, (), base)
    except ConfigError as cause:
        raise ConfigError(f"{path}: {cause}") from None


def _document(path: Path) -> dict[str, Any]:
    """The keys and values of a TOML file; Windows' editors put a mark before its first letter."""
    text = ""
    try:
        text = path.read_text(encoding="utf-8-sig")
        return tomllib.loads(text)
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
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is not text in UTF-8; save it as UTF-8") from None
    except (ValueError, RecursionError) as cause:
        raise ConfigError(
            f"{path} is not TOML: {_no_toml(cause, text)}; correct it, or station setup --replace "
            "writes a new one"
        ) from None


def _no_toml(cause: Exception, text: str) -> str:
    """Words for what the parser found; Python's own are advice to programmers."""
    if isinstance(cause, RecursionError):
        return "it has brackets in brackets in brackets, on and on"
    if not isinstance(cause, tomllib.TOMLDecodeError):
        return "it has a number of thousands of digits"
    # A section's name is told as a Python tuple.
    said = re.sub(r"\('([^()]*)',?\)", lambda found: found[1].replace("', '", "."), str(cause))
    comma = _DECIMAL_COMMA.search(text)
    return said + (f" ({comma[0].strip()}: write a point, 1.8)" if comma else "")


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
    """A key as it is written in TOML; of several sections by the number of its own, from 1."""
    key = ""
    for part in place:
        key += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if key else part
    return key


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
        return f"{key} is missing; add it"
    if problem["type"] == "tuple_type" and isinstance(problem["input"], dict):
        return f"{key}: there can be several; write [[{key}]]"
    if problem["type"] in _MUST:
        said = _MUST[problem["type"]].format(**problem.get("ctx", {}))
    else:
        said = problem["msg"].removeprefix("Value error, ").replace("Input should", "must")
    # The key says already which section is meant.
    found = "" if isinstance(problem["input"], dict | Strict) else _found(problem["input"])
    return f"{key}: {said}{found}" if key else f"{said}{found}"


def _found(value: Any) -> str:
    """A value as TOML has it, cut to a readable length."""
    return f" (found {json.dumps(value, default=str, ensure_ascii=False):.80})"
