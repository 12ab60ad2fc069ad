"""SeamlyMe's individual measurements (.smis, format 0.3.4), for pattern making in Seamly2D."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from station.archive.records import ScanRecord
from station.core.words.terms import TERMS, plain_name, split_side, verdict_words

VERSION = "0.3.4"
_NO_SYSTEM = "998"
"""The code for no pattern making system."""
_NO_BIRTHDAY = "1800-01-01"


def smis(scan: ScanRecord, document: dict[str, Any]) -> bytes:
    """The file: centimetres, one entry for each measurement that has a value.

    SeamlyMe's names have no sides. As ISO 8559-1 measures the right side, its own names take the
    right one; the left one, and what SeamlyMe does not know, becomes a custom measurement, whose
    name begins with @.
    """
    root = ElementTree.Element("smis")
    verdict = verdict_words(scan.verdict, "en")
    note = f"{scan.label}; {scan.scan_id}; {verdict}; pose {document['pose']}"
    for name, text in (("version", VERSION), ("read-only", "false"), ("notes", note),
                       ("unit", "cm"), ("pm_system", _NO_SYSTEM)):  # fmt: skip
        ElementTree.SubElement(root, name).text = _legal(text)
    person = ElementTree.SubElement(root, "personal")
    personal = {"family-name": scan.label, "given-name": "", "birth-date": _NO_BIRTHDAY}
    for name, text in {**personal, "gender": "unknown", "email": ""}.items():
        ElementTree.SubElement(person, name).text = _legal(text)
    body = ElementTree.SubElement(root, "body-measurements")
    for row in document["measurements"]:
        if row["value_m"] is None:
            continue
        attributes = {"name": seamly_name(row["name"]), "value": f"{100 * row['value_m']:.2f}"}
        if attributes["name"].startswith("@"):
            attributes["full_name"] = plain_name(row["name"])
        ElementTree.SubElement(body, "m", attributes)
    ElementTree.indent(root, "    ")
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def seamly_name(name: str) -> str:
    """SeamlyMe's name of a row."""
    stem, side = split_side(name)
    known = TERMS[stem].seamly if stem in TERMS else ""
    return known if known and side != "left" else f"@{name}"


def _legal(text: str) -> str:
    """Text without the characters that XML 1.0 does not allow."""
    return "".join(c for c in text if c in "\t\n\r" or (ord(c) >= 32 and ord(c) not in _NOT_XML))


_NOT_XML = frozenset((*range(0xD800, 0xE000), 0xFFFE, 0xFFFF))
