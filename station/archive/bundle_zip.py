"""All files of a result in one archive, with printable and spreadsheet versions."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from station.archive.records import ScanRecord
from station.archive.sheet import sheet_pdf
from station.archive.smis import smis
from station.archive.tables import Unit, csv_table, read_measurements
from station.core.words.tables import FILES
from station.core.words.terms import Language

MEDIA_TYPES = {
    ".json": "application/json",
    ".png": "image/png",
    ".glb": "model/gltf-binary",
    ".ply": "application/octet-stream",
    ".obj": "model/obj",
}
_STORED = (".png", ".glb", ".ply")
"""File types that are not worth compressing."""


def result_zip(scan: ScanRecord, folder: Path, unit: Unit, language: Language) -> bytes:
    """A ZIP archive of a result; everything in it lies in a folder named by the scan."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=3) as archive:
        for path in sorted(folder.iterdir()):
            if path.is_file() and not path.is_symlink():
                how = zipfile.ZIP_STORED if path.suffix in _STORED else zipfile.ZIP_DEFLATED
                archive.write(path, f"{scan.scan_id}/{path.name}", how)
        for pose, name in FILES.items():
            document = read_measurements(folder, pose)
            stem = Path(name).stem
            table = csv_table(scan, document, unit, language)
            archive.writestr(f"{scan.scan_id}/{stem}.csv", table)
            if pose == "as-scanned":
                archive.writestr(f"{scan.scan_id}/individual.smis", smis(scan, document))
        sheet = sheet_pdf(scan, folder, "as-scanned", unit, language)
        archive.writestr(f"{scan.scan_id}/sheet.pdf", sheet)
    return stream.getvalue()
