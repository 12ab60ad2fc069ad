"""The units start the commands that there are, under the names that the target wants."""

import configparser
from pathlib import Path

import pytest

from station.cli import COMMANDS as STATION
from workers.cli import COMMANDS as RECONSTRUCT

UNITS = Path(__file__).parents[2] / "systemd"


def _read(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(path)
    return parser


@pytest.mark.parametrize("path", sorted(UNITS.glob("*.service")), ids=lambda path: path.name)
def test_a_unit_starts_a_command_that_exists(path: Path) -> None:
    service = _read(path)["Service"]
    program, command, *_ = service["ExecStart"].split()
    table = {"station": STATION, "reconstruct": RECONSTRUCT}[Path(program).name]
    assert command in table
    assert service["UMask"] == "0077"
    assert service["NoNewPrivileges"] == "yes"


def test_the_target_wants_units_that_exist() -> None:
    wanted = [
        name
        for line in (UNITS / "booth.target").read_text().splitlines()
        if line.startswith("Wants=")
        for name in line.removeprefix("Wants=").split()
    ]
    files = {path.name for path in UNITS.iterdir()}
    for name in wanted:
        template = name.split("@")[0] + "@.service" if "@" in name else name
        assert template in files
