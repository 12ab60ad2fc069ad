"""Files that survive a crash: whole under their final name, or not there at all."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import stat
import time
import uuid
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from station.core.errors import BoothError, DiskReadError, FormatError

PRIVATE_FOLDER_MODE = 0o700
"""Body scans are personal data: only the service's user may read them."""
PRIVATE_FILE_MODE = 0o600
OF_THE_DISK = (errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Reasons why a file cannot be read that are not its own and may pass."""
_LONGEST_TIME = 32
"""Letters of a time with microseconds and its offset."""
_LOCK_TRIES, _LOCK_PAUSE_S = 4, 0.05
MAX_JSON_BYTES = 16 << 20
"""A bundle of 100 frames of 8 cameras takes 0.2 MB, a result's paths and parameters 1 MB."""


def utc_now(precision: Literal["seconds", "milliseconds"] = "seconds") -> str:
    """The time that is written into what is made now, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec=precision).replace("+00:00", "Z")


def local_time(moment: str) -> str:
    """A time in UTC, ISO 8601, as the booth's clock on the wall shows it; others stay as they are,
    but for control characters, which must not reach a terminal, and for what is longer than a time.

    For what people read; files and programs keep UTC.
    """
    try:
        then = datetime.fromisoformat(moment)
        if then.tzinfo is None:
            then = then.replace(tzinfo=UTC)
        return then.astimezone().strftime("%Y-%m-%d %H:%M:%S")
    except (ValueError, OverflowError):
        return "".join(c if c.isprintable() else "?" for c in moment[:_LONGEST_TIME])


def fsync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_file(path: Path) -> None:
    """Make a file's content durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def private_folder(folder: Path) -> Path:
    """Create a folder (and its parents) that only its owner may read."""
    folder.mkdir(mode=PRIVATE_FOLDER_MODE, parents=True, exist_ok=True)
    return folder


def open_private(path: str | Path, flags: int) -> int:
    """Open a file, a new one for its owner alone: an opener for `open`.

    Unlike a mask of the process, which every thread's files and folders would be made with.
    """
    return os.open(path, flags | os.O_CLOEXEC, PRIVATE_FILE_MODE)


def private_file(path: Path) -> Path:
    """Create an empty file that only its owner may read, if there is none.

    Not for a database that this process has open: to close the file would drop its locks.
    """
    os.close(open_private(path, os.O_RDWR | os.O_CREAT))
    return path


@contextmanager
def held(path: Path, busy: BoothError) -> Iterator[None]:
    """Hold a lock file exclusively; it is released when the block or the process ends.

    Raises:
        BoothError: `busy`, if another process holds it.
    """
    private_folder(path.parent)
    descriptor = open_private(path, os.O_RDWR | os.O_CREAT)
    try:
        for left in reversed(range(_LOCK_TRIES)):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                # `is_held` takes it for an instant.
                if left == 0:
                    raise busy from None
                time.sleep(_LOCK_PAUSE_S)
        yield
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether a living process holds a lock file (see `held`)."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def entries_of(folder: Path) -> list[Path]:
    """Contents of a folder, sorted; nothing if there is no such folder.

    Unlike `Path.glob`, which takes a folder that it may not read for an empty one.

    Raises:
        OSError: the folder cannot be read.
    """
    try:
        return sorted(folder.iterdir())
    except FileNotFoundError:
        return []


Version = tuple[int, int, int]


def version_of(path: Path) -> Version:
    """Inode, time and size of a file, which tell whether it has to be read again.

    Raises:
        OSError: it is not there, or cannot be looked at.
    """
    file = path.stat()
    return file.st_ino, file.st_mtime_ns, file.st_size


def disk_words(error: OSError) -> str:
    """Words on a refusal of the disk, with its place and the remedy."""
    return (
        f"the disk cannot be written ({error.strerror or error}: {error.filename or 'spool'}); "
        "free some space or repair it, see station status"
    )


def delete(path: Path) -> None:
    """Remove a file, a link (not what it leads to), or a folder with its contents.

    Raises:
        OSError: it is not there, or the disk refuses.
    """
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def read_regular(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file: no link is followed, no device or pipe is read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a regular file, or larger than ``most_bytes``.
        OSError: the disk cannot be read.
    """
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags)
    except OSError as cause:
        if cause.errno == errno.ELOOP:
            raise ValueError("is a link, not a file") from None
        raise
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("is not a regular file")
        if status.st_size > most_bytes:
            raise ValueError(f"has {status.st_size} bytes, at most {most_bytes} are allowed")
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            # As much as it has, not as much as it may have: room for that would be made at once.
            return stream.read(status.st_size)
    finally:
        os.close(descriptor)


def read_bounded_json(path: Path, most_bytes: int) -> Any:
    """A JSON document of bounded size.

    Raises:
        FileNotFoundError, OSError: as read_regular.
        ValueError: it is not a regular file, too large, or not JSON (or nested too deeply).
    """
    try:
        return json.loads(read_regular(path, most_bytes))
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def write_bytes(path: Path, data: bytes, *, durable: bool = True, private: bool = False) -> None:
    """Write a file so that a reader, or a crash, sees the old content or the new, never a part.

    Without ``durable`` it survives the end of the process, but not always a loss of power. What
    is ``private`` only its owner may read.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "wb", opener=open_private if private else None) as stream:
            stream.write(data)
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    if durable:
        fsync_folder(path.parent)


def write_json(path: Path, document: Any, *, durable: bool = True) -> None:
    """Write JSON atomically; NaN and infinity are refused (they are not JSON)."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    write_bytes(path, (text + "\n").encode(), durable=durable)


def read_json(
    path: Path,
    *,
    format: str,
    versions: Collection[int],
    error: type[FormatError] = FormatError,
) -> dict[str, Any]:
    """Read a JSON document of a known format and version.

    Raises:
        FormatError (or the subclass ``error``): the file is missing, torn, too large, a link, of
            another format, or of a version not in ``versions``; the message names the file and
            what was found.
        DiskReadError: the disk refuses.
    """
    try:
        document = read_bounded_json(path, MAX_JSON_BYTES)
    except FileNotFoundError:
        raise error(f"{path} is missing; a {format} file was expected there") from None
    except (OSError, ValueError) as cause:
        if isinstance(cause, OSError) and cause.errno in OF_THE_DISK:
            raise DiskReadError(
                f"{path} cannot be read ({cause.strerror}); check its disk"
            ) from None
        # Behind a semicolon is advice to programmers.
        said = str(cause).partition(";")[0]
        raise error(f"{path} cannot be read as JSON ({said}); restore it from its source") from None
    found = document.get("format") if isinstance(document, dict) else type(document).__name__
    if found != format:
        raise error(f"{path} is not a {format} file (its format is {found!r})")
    version = document.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version not in versions:
        readable = ", ".join(str(known) for known in sorted(versions))
        raise error(
            f"{path} has {format} version {version!r}; this program reads {readable}; "
            "read it with the version that wrote it"
        )
    return dict(document)


def _raise(error: OSError) -> None:
    raise error


def publish_folder(temporary: Path, final: Path) -> None:
    """Give a finished folder its final name: fsync everything in it, rename, fsync the parent.

    Both must lie in one file system. ``final`` must not exist: a result is never overwritten.

    Raises:
        FileExistsError: ``final`` is there already.
        OSError: the disk refused.
    """
    if final.exists():
        raise FileExistsError(f"{final} exists already")
    for root, _, names in os.walk(temporary, onerror=_raise):
        for name in names:
            fsync_file(Path(root) / name)
        fsync_folder(Path(root))
    os.rename(temporary, final)
    fsync_folder(final.parent)
    if temporary.parent != final.parent:
        fsync_folder(temporary.parent)
