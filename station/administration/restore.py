"""`station restore`: restores a backup."""

from __future__ import annotations

import shutil
from pathlib import Path

import click

from station.administration import units
from station.administration.archive import CONTENT, Part, check, part, restore_part
from station.administration.booth_file import CONFIG, STATE_FOLDER, administration
from station.administration.migrate import migrate
from station.administration.ownership import USER, give_to_booth, is_installed_root
from station.core.commands import config_option
from station.core.config_file import find_config, load_config, option_for
from station.core.errors import ConfigError


@click.command()
@click.argument("backup", type=click.Path(path_type=Path, file_okay=False))
@config_option
def restore(backup: Path, config_path: Path | None) -> None:
    """Restore what `station backup` saved in BACKUP; the booth must be stopped.

    The whole backup is checked before anything is changed. What it replaces stays beside it, named
    .NAME.before-restore, .NAME.before-restore-2 and so on.

    \b
    Examples:
      systemctl stop booth.target
      station restore /media/usb/booth-20261122T073000Z
      station setup
    """
    path = find_config(config_path).resolve()
    units.check_stopped(_runtime_folder(path))
    if path == CONFIG and not is_installed_root():
        raise ConfigError(f"{path} belongs to root: run it with sudo, or give another --config")
    with administration(path):
        names, kept = _restore(backup.resolve(), path)
    click.echo(f"{backup.resolve().name} is restored: {', '.join(names)}")
    if kept:
        click.echo("what was there before is kept until you delete it:")
    for place in kept:
        click.echo(f"  {place}")
    click.echo("next: station setup" if path == CONFIG else f"next: station run{option_for(path)}")


def _runtime_folder(path: Path) -> Path:
    """Runtime folder of a booth; its own folder if booth.toml cannot be read, and nothing runs."""
    try:
        return load_config(path).runtime.folder
    except ConfigError:
        return path.parent


def _restore(backup: Path, path: Path) -> tuple[list[str], list[Path]]:
    """Restore a backup to the booth of this booth.toml.

    Returns:
        the names of its parts, and where what they replace is kept.
    """
    names = check(backup)
    saved = load_config(backup / CONTENT / "booth.toml")
    for name in names:
        part(name, path, saved)
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = [restore_part(backup, Part("booth.toml", path))]
    config = load_config(path)
    others = [part(name, path, config) for name in names if name != "booth.toml"]
    kept += [restore_part(backup, one) for one in others]
    if path == CONFIG:
        give_to_booth([STATE_FOLDER, config.spool.folder])
        _protect(path.parent)
        migrate(STATE_FOLDER)
    return names, [place for place in kept if place is not None]


def _protect(folder: Path) -> None:
    """The services read the configuration and what lies beside it, and do not write it."""
    for place in folder.rglob("*"):
        if not place.is_symlink():
            shutil.chown(place, "root", USER)
            place.chmod(0o750 if place.is_dir() else 0o640)
