"""The packages' dependencies: each one that pyproject.toml names is pinned, with hashes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LOCKS = ROOT / "deploy/lock"


def _pins(name: str) -> dict[str, str]:
    text = (LOCKS / name).read_text()
    return dict(re.findall(r"^([a-z0-9][a-z0-9.-]*)==(\S+) \\$", text, re.MULTILINE))


def _required(extra: str | None) -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [*project["dependencies"]]
    named += project["optional-dependencies"][extra] if extra else []
    return [Requirement(words) for words in named]


@pytest.mark.parametrize(("name", "extra"), [("booth.txt", None), ("simulation.txt", "simulation")])
def test_every_dependency_is_pinned_as_it_is_asked_for(name: str, extra: str | None) -> None:
    """A dependency that is added without `make lock` would be missing from the package."""
    pins = _pins(name)
    unmet = [
        str(requirement)
        for requirement in _required(extra)
        if not requirement.specifier.contains(pins.get(requirement.name, "0"))
    ]
    assert unmet == [], "call `make lock`"


@pytest.mark.parametrize("name", ["booth.txt", "simulation.txt", "build.txt"])
def test_every_pin_has_its_hashes(name: str) -> None:
    entries = re.split(r"\n(?=[a-z0-9])", (LOCKS / name).read_text())
    assert len(_pins(name)) == len(entries) - 1
    assert [entry.split()[0] for entry in entries[1:] if "--hash=sha256:" not in entry] == []


def test_what_both_packages_hold_is_of_one_version() -> None:
    """The simulation's package is installed beside the booth's, not instead of it."""
    booth, simulation = _pins("booth.txt"), _pins("simulation.txt")
    assert booth == {name: simulation[name] for name in booth}
