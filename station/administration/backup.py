"""`station backup`: configuration, calibrations and other data of this booth, saved into a
folder."""

from __future__ import annotations

from pathlib import Path

import click

from station.administration import units
from station.administration.archive import check, parts, save
from station.core.commands import config_option
from station.core.config_file import find_config, load_config
from station.core.errors import InputError


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@config_option
@click.option("--with-scans", is_flag=True, help="also scans and results (personal data)")
def backup(folder: Path, config_path: Path | None, with_scans: bool) -> None:
    """Save configuration, calibrations and other data of the booth into FOLDER, which exists.

    Each backup is a folder of its own with the time in its name, readable by you alone. It is read
    back and verified before the command ends. The booth may keep running, except with
    --with-scans.

    \b
    Examples:
      station backup /media/usb
      station backup /media/usb --with-scans
    """
    if not folder.is_dir():
        # A drive that is not mounted would be made on the system's own disk.
        raise InputError(f"{folder} is no folder; is the drive mounted?")
    path = find_config(config_path).resolve()
    config = load_config(path)
    if with_scans:
        # Scans change while the booth is running.
        units.check_stopped(config.runtime.folder)
    saved, count = save(folder, path, config, with_scans=with_scans)
    check(saved)
    click.echo(f"{saved}: {count} files, read back and verified")
    if not with_scans:
        click.echo("scans and results are not in it (--with-scans)")
    places = [part.place for part in parts(path, config)]
    for target in config.deliver:
        secret = target.secret_file
        if secret is not None and not any(secret.is_relative_to(place) for place in places):
            click.echo(f"the secret of deliver {target.name} is not in it: keep {secret}, too")
