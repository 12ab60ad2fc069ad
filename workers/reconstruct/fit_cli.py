"""`reconstruct fit`: one bundle or cloud, without a station."""

from __future__ import annotations

import os
import shlex
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from station.core.commands import COMPILING, writable_folder
from station.core.errors import InputError
from station.core.files import PRIVATE_FOLDER_MODE, publish_folder
from workers.scape.fit.fit import Method

if TYPE_CHECKING:
    from workers.reconstruct.job import JobSummary


@click.command()
@click.argument("bundle", type=click.Path(path_type=Path), required=False)
@click.option("--cloud", type=click.Path(path_type=Path), help="a point cloud, .ply or .pcd")
@click.option(
    "--up",
    type=click.Choice(["z", "y", "x", "-z", "-y", "-x"]),
    default="z",
    show_default=True,
    help="of it",
)
@click.option(
    "--unit",
    type=click.Choice(["m", "cm", "mm", "in"]),
    default="m",
    show_default=True,
    help="of it",
)
@click.option(
    "--out", "out_folder", type=click.Path(path_type=Path), required=True, help="new folder"
)
@click.option("--method", type=click.Choice(get_args(Method)), default="joint", show_default=True)
@click.option(
    "--debug",
    "debug_folder",
    type=click.Path(path_type=Path),
    help="new folder for pictures of every stage: cloud, pairs, body over cloud, error map; "
    "without it, none are drawn",
)
@click.option("--quiet", is_flag=True, help="no progress")
def fit(
    bundle: Path | None,
    cloud: Path | None,
    up: str,
    unit: str,
    out_folder: Path,
    method: Method,
    debug_folder: Path | None,
    quiet: bool,
) -> None:
    """Reconstruct a scan bundle, or a point cloud from any scanner.

    Exit code 0 for a result (also one that says "rescan"); 1 for input that cannot be used.

    \b
    Examples:
      reconstruct fit spool/done/20261121T100000Z-7f3a --out result
      reconstruct fit --cloud body.ply --up y --unit mm --out result
      reconstruct fit BUNDLE --out result --debug pictures
    """
    if (bundle is None) == (cloud is None):
        raise click.UsageError("give either a bundle or --cloud FILE")
    if bundle is not None and bundle.suffix.lower() in (".ply", ".pcd"):
        raise click.UsageError(f"{bundle} is no scan bundle; for a point cloud: --cloud {bundle}")
    for source in (bundle, cloud):
        if source is not None and not source.exists():
            raise InputError(f"{source} does not exist")
    _check_folders(out_folder, debug_folder)
    from workers.reconstruct.compiling import compilation_told
    from workers.reconstruct.job import reconstruct_bundle

    def tell_of_compilation() -> None:
        if not quiet:
            click.echo(COMPILING, err=True)

    def show(step: str, share: float) -> None:
        if not quiet:
            click.echo(f"{step} {100 * share:3.0f} %", err=True)

    temporary = Path(tempfile.mkdtemp(prefix=".fit-", dir=out_folder.parent))
    try:
        options = {"method": method, "progress": show, **_observation(debug_folder)}
        with compilation_told(tell_of_compilation):
            if bundle is not None:
                summary = reconstruct_bundle(bundle, temporary, **options)
            else:
                assert cloud is not None
                summary = _of_cloud(cloud, up, unit, temporary, options)
        _publish(temporary, out_folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    click.echo(f"{out_folder}: {summary.status}")
    for words in (*summary.reasons, *summary.notes):
        click.echo(f"  {words}")
    if not quiet:
        folder = shlex.quote(str(out_folder))
        click.echo(f"its table: reconstruct measure {folder}", err=True)


def _observation(debug_folder: Path | None) -> dict[str, Any]:
    """Options of a fit of which pictures are drawn; none without a folder for them."""
    if debug_folder is None:
        return {}
    from workers.pictures.debug_pictures import DebugPictures
    from workers.scape.model.body_model import load_model

    model = load_model()
    return {"model": model, "observer": DebugPictures(debug_folder, model.faces)}


def _of_cloud(
    cloud: Path, up: str, unit: str, folder: Path, options: Mapping[str, Any]
) -> JobSummary:
    from workers.cloud.cloud_file import read_cloud
    from workers.reconstruct.job import reconstruct_cloud

    options["progress"]("reading", 0.0)
    points = read_cloud(cloud, up, unit)
    if points.blank:
        said = f"{cloud}: {points.blank} points without a reading (NaN) are left out"
        click.echo(said, err=True)
    return reconstruct_cloud(points, cloud.stem, folder, **options)


def _publish(temporary: Path, out_folder: Path) -> None:
    """Give the result its name, or another one where the name was taken during the fit.

    Raises:
        InputError: the name was taken; the message says where the result is.
    """
    try:
        publish_folder(temporary, out_folder)
    except OSError:
        if not (temporary.exists() and os.path.lexists(out_folder)):
            raise
        kept = Path(f"{out_folder}-{temporary.name.removeprefix('.fit-')}")
        publish_folder(temporary, kept)
        raise InputError(
            f"{out_folder} was made by somebody else during the fit; the result is in {kept}"
        ) from None


def _check_folders(out_folder: Path, debug_folder: Path | None) -> None:
    """Make what the new folders lie in, before any work is done for them.

    Raises:
        InputError: one of them cannot be made, or holds another fit's files.
    """
    try:
        # A link that leads nowhere does not exist, but a folder cannot take its name.
        out_folder.lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as cause:
        raise InputError(
            f"{out_folder} cannot be made ({cause.strerror}); name another folder with --out"
        ) from None
    else:
        raise InputError(f"{out_folder} exists already; name a new folder with --out")
    writable_folder(out_folder.parent, "--out")
    if debug_folder is not None:
        from workers.pictures.debug_pictures import has_pictures

        # Unlike Path.resolve, without an error where links run in a circle.
        pictures, result = (os.path.realpath(folder) for folder in (debug_folder, out_folder))
        if Path(pictures).is_relative_to(result):
            raise InputError(
                f"{debug_folder} would lie in {out_folder}, which has to be new; name a folder "
                "elsewhere with --debug"
            )
        if has_pictures(debug_folder):
            raise InputError(
                f"{debug_folder} has pictures of a fit already; name a new folder with --debug"
            )
        # Pictures of a body are as private as its scan.
        writable_folder(debug_folder, "--debug", PRIVATE_FOLDER_MODE)
