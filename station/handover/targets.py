"""Targets of results: a folder that gets copies, a webhook that gets signed POSTs."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import shutil
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Protocol

from station.archive.records import ScanRecord
from station.archive.smis import smis
from station.archive.tables import csv_table, read_measurements, rows
from station.core.config import DeliverConfig
from station.core.errors import BoothError
from station.core.files import fsync_file, fsync_folder
from station.core.words.tables import FILES

_TIMEOUT_S = 10.0
_LINKS = ("mesh.glb", "mesh.obj", "preview.png", "avatar.glb")


class HandOverError(BoothError):
    """The target did not accept the result; it will be retried."""


class Target(Protocol):
    """Takes a result, or raises HandOverError."""

    def __call__(self, scan: ScanRecord, result: Path) -> None: ...


def make_target(config: DeliverConfig) -> Target:
    """The target of a section of booth.toml."""
    if config.folder is not None:
        return FolderTarget(config.folder)
    assert config.url is not None
    assert config.secret_file is not None
    return WebhookTarget(config.name, config.url, config.secret_file, config.link)


class FolderTarget:
    """Copies a result under a temporary name, then renames it: a reader never sees part of one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, scan: ScanRecord, result: Path) -> None:
        final = self._folder / scan.scan_id
        beside = self._folder / f".{scan.scan_id}.part"
        try:
            # A share whose server is down refuses even these.
            if final.exists():
                return
            if not self._folder.is_dir():
                raise HandOverError(f"{self._folder} does not exist; is the share mounted?")
            try:
                _copy(scan, result, beside)
                beside.rename(final)
            except BaseException:
                # Nobody would remove it if the scan is deleted before the next try.
                shutil.rmtree(beside, ignore_errors=True)
                raise
            fsync_folder(self._folder)
        except OSError as cause:
            # That of a copy lists each file: from where, to where, why not.
            several = isinstance(cause, shutil.Error)
            reason = cause.args[0][0][2] if several else cause.strerror or cause
            raise HandOverError(f"{self._folder} cannot be written ({reason})") from None


def _copy(scan: ScanRecord, result: Path, beside: Path) -> None:
    """Copy a result, with tables for other programs, to a folder that is on the disk then."""
    if beside.exists():
        shutil.rmtree(beside)
    shutil.copytree(result, beside)
    document = read_measurements(result, "as-scanned")
    (beside / "individual.smis").write_bytes(smis(scan, document))
    for pose, name in FILES.items():
        table = csv_table(scan, read_measurements(result, pose), "cm", "en")
        (beside / name).with_suffix(".csv").write_text(table, encoding="utf-8", newline="")
    for path in beside.iterdir():
        fsync_file(path)
    fsync_folder(beside)


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirected POST would send a person's measurements to an address that the answer
    chooses."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str,
        headers: Any, newurl: str,
    ) -> None:  # fmt: skip
        del req, fp, code, msg, headers, newurl


def _refusal(url: str, cause: Exception) -> HandOverError:
    """The words for a POST that the receiver did not accept."""
    if isinstance(cause, urllib.error.HTTPError):
        if cause.code // 100 == 3:
            return HandOverError(
                f"{url} answers {cause.code}, a redirection, which is not followed"
            )
        return HandOverError(f"{url} answers {cause.code}")
    if isinstance(cause, TimeoutError):
        return HandOverError(f"{url} has not answered within {_TIMEOUT_S:g} s")
    reason = getattr(cause, "reason", cause)
    if isinstance(reason, ssl.SSLCertVerificationError):
        return HandOverError(f"the certificate of {url} is not trusted ({reason.verify_message})")
    words = getattr(reason, "strerror", None) or str(reason).strip()
    return HandOverError(f"{url} cannot be reached ({words})")


class WebhookTarget:
    """Posts a result's JSON with links to its files, signed.

    `Booth-Signature: t=<seconds>,v1=<hex>`, v1 = HMAC-SHA256(secret, "<seconds>." + body). The
    receiver computes it again, compares, and refuses old times. `Idempotency-Key` is the same
    whenever the same result is posted again: the station may die between the receiver's answer and
    recording it.
    """

    def __init__(self, name: str, url: str, secret_file: Path, link: str) -> None:
        self._name, self._url = name, url
        self._secret_file, self._link = secret_file, link.rstrip("/")

    def __call__(self, scan: ScanRecord, result: Path) -> None:
        body = json.dumps(self.document(scan, result), ensure_ascii=False).encode()
        headers = {
            "Content-Type": "application/json",
            "Idempotency-Key": f"{self._name}/{scan.scan_id}",
            "Booth-Signature": self.signature(body, int(time.time())),
        }
        request = urllib.request.Request(self._url, body, headers, method="POST")
        opener = urllib.request.build_opener(_NoRedirect)
        try:
            with opener.open(request, timeout=_TIMEOUT_S):
                pass
        except (OSError, ValueError, http.client.HTTPException) as cause:
            # What is no HTTP is neither an OSError nor a ValueError.
            raise _refusal(self._url, cause) from None

    def signature(self, body: bytes, seconds: int) -> str:
        """The header's value.

        Raises:
            HandOverError: the secret cannot be read.
        """
        try:
            secret = self._secret_file.read_bytes().strip()
        except OSError as cause:
            raise HandOverError(f"{self._secret_file} cannot be read ({cause.strerror})") from None
        mac = hmac.new(secret, f"{seconds}.".encode() + body, hashlib.sha256).hexdigest()
        return f"t={seconds},v1={mac}"

    def document(self, scan: ScanRecord, result: Path) -> Mapping[str, Any]:
        """The document that is posted."""
        at = f"{self._link}/api/v1/scans/{scan.scan_id}"
        tables = {pose: rows(read_measurements(result, pose), "m", "en") for pose in FILES}
        return {
            "event": "result",
            "scan_id": scan.scan_id,
            "label": scan.label,
            "booth": scan.booth,
            "created": scan.created,
            "verdict": scan.verdict,
            "reasons": list(scan.reasons),
            "unit": "m",
            "measurements": tables,
            "links": {name: f"{at}/files/{name}" for name in _LINKS} if self._link else {},
        }
