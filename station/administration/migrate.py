"""`station migrate`: bring the state folder to this version's layout, or refuse an unknown one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import click

from station.administration.booth_file import STATE_FOLDER
from station.core.errors import FormatError
from station.core.files import private_folder, read_json, write_json

STATE = "state.json"
FORMAT = "booth-state"
VERSION = 1
"""Increased with every change of the layout; deploy/package/body-booth/preinst names the versions
that it reads."""

_HOLDS = frozenset({STATE, "calibration.json", "calibrations", "console", "spool"})
"""Names of which a station's state folder holds one, unless it is new."""

Migrations = Mapping[int, Callable[[Path], None]]
MIGRATIONS: Migrations = {}
"""Version -> function that migrates to the next version; may be repeated after a crash."""


def migrate(folder: Path, migrations: Migrations = MIGRATIONS, version: int = VERSION) -> int:
    """Bring a state folder to `version`, one step at a time; returns the version found.

    A folder without state.json is new, or as old as the first version: both are version 1.

    Raises:
        FormatError: the folder is of a version that cannot be brought to this one.
    """
    path = folder / STATE
    found = 1
    if path.exists():
        known = {*migrations, version}
        found = int(read_json(path, format=FORMAT, versions=known)["version"])
    for step in range(found, version):
        if step not in migrations:
            raise FormatError(
                f"{folder} has layout version {step}, which this program cannot bring to version "
                f"{version}; install the package of a version between them first"
            )
        migrations[step](folder)
        write_json(path, {"format": FORMAT, "version": step + 1})
    if not path.exists():
        write_json(private_folder(folder) / STATE, {"format": FORMAT, "version": version})
    return found


def check_is_state(folder: Path) -> None:
    """Refuse a folder of somebody else, in which a state would be begun.

    Raises:
        FormatError: it holds something, and nothing of a station. The installed booth's own folder
            may be a disk with what disks hold.
    """
    held = {entry.name for entry in folder.iterdir()}
    if folder != STATE_FOLDER and held and not held & _HOLDS:
        raise FormatError(
            f"{folder} is no station's state folder: it holds none of {', '.join(sorted(_HOLDS))}; "
            "name the right one with --state"
        )


@click.command()
@click.option(
    "--state",
    "folder",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    default=STATE_FOLDER,
    show_default=True,
    help="the state folder",
)
def migrate_command(folder: Path) -> None:
    """Bring the state folder to this version's layout; the package does it on every upgrade.

    \b
    Examples:
      station migrate
    """
    check_is_state(folder)
    found = migrate(folder)
    if found != VERSION:
        click.echo(f"{folder}: layout version {found} is now version {VERSION}")
