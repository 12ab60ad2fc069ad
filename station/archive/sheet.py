"""One A4 page to print: every line drawn on the body, the table, the verdict."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image
from reportlab.lib.colors import HexColor
from reportlab.lib.pagesizes import A4
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.cidfonts import UnicodeCIDFont
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas

from station.archive.figure import Line, View, draw_views, heading_rad
from station.archive.phrases import in_language
from station.archive.records import ScanRecord
from station.archive.surfaces import read_mesh
from station.archive.tables import (
    DIGITS,
    Unit,
    mark_of,
    notes_on_marks,
    read_measurements,
    rows,
    side_differences,
)
from station.core.words.tables import Pose
from station.core.words.terms import Language, verdict_words

_WIDTH, _HEIGHT = A4
_MARGIN = 34.0
_MOST_LETTERS = 200
"""Letters of a label, or of a line of reasons, that are looked at: no more fit into the head."""
_REASONS_SIZE, _REASONS_LINES = 7.0, 3
_FIGURE_TOP, _FIGURE_HEIGHT = _HEIGHT - 104.0, 316.0
_ROW_HEIGHT = 13.6
_DIFFERENCE = 60.0
"""From a column's right edge to where the differences of left and right end."""
_INK, _GREY, _RULE = HexColor("#16202c"), HexColor("#5c6a7a"), HexColor("#cdd5de")
_LINE = HexColor("#c2410c")
_COLOURS = {"ok": HexColor("#15803d"), "rescan": HexColor("#b45309")}
_WORDS: dict[Language, dict[str, str]] = {
    "en": {"front": "front", "left": "left side", "back": "back", "as-scanned": "as scanned",
           "standard": "standard pose", "value": "value", "l": "left", "r": "right",
           "difference": "left - right",
           "note": "± half the 95 % interval. Lines are drawn where they were measured. "
           "Differences of the sides in bold are larger than their interval.",
           "unlabelled": "no label"},
    "zh": {"front": "正面", "left": "左侧", "back": "背面", "as-scanned": "扫描姿势",
           "standard": "标准姿势", "value": "数值", "l": "左", "r": "右",
           "difference": "左 - 右",
           "note": "± 为 95 % 区间的一半。线条画在扫描姿势下的测量位置。粗体的左右差值超出其区间。",
           "unlabelled": "无标签"},
}  # fmt: skip
_LATIN, _BOLD, _CHINESE, _OTHER = "Helvetica", "Helvetica-Bold", "STSong-Light", "Other"
_OTHER_FILES = (
    Path("/usr/share/fonts/truetype/droid/DroidSansFallbackFull.ttf"),
    Path("/usr/share/fonts-droid-fallback/truetype/DroidSansFallback.ttf"),
)
"""Debian's fonts-droid-fallback: one TrueType font of nearly every script, so that it is embedded.
STSong-Light is not embedded: viewers substitute it, printers may not."""


@dataclass(frozen=True, slots=True)
class _Entry:
    """One numbered row of the sheet: a measurement with its sides together."""

    number: int
    words: str
    names: tuple[str, ...]
    values: tuple[tuple[str, float | None, float, str], ...]
    """(side, value, half of the interval, mark of its basis); no value where the row is blank."""
    difference: tuple[float, bool] | None
    """Left less right, and whether it is more than its interval."""


def sheet_pdf(scan: ScanRecord, folder: Path, pose: Pose, unit: Unit, language: Language) -> bytes:
    """The page as PDF.

    Raises:
        FormatError: the result is damaged.
    """
    drawn = read_measurements(folder, "as-scanned")["measurements"]
    table = read_measurements(folder, pose)
    listed = rows(table, unit, language)
    entries = _entries(listed, side_differences(table, unit, language))
    views = draw_views(read_mesh(folder / "mesh.ply"), drawn, heading_rad(folder))
    stream = io.BytesIO()
    canvas = Canvas(stream, pagesize=A4, invariant=True)
    canvas.setTitle(scan.label or scan.scan_id)
    _head(canvas, scan, pose, unit, language)
    _figures(canvas, views, entries, language)
    _table(canvas, entries, unit, language)
    _text(canvas, _MARGIN, 28, _WORDS[language]["note"], 7, _GREY)
    _text(canvas, _MARGIN, 18, "   ".join(notes_on_marks(listed, language)), 7, _GREY)
    canvas.showPage()
    canvas.save()
    return stream.getvalue()


def _entries(
    table: Sequence[dict[str, Any]], differences: Sequence[dict[str, Any]]
) -> list[_Entry]:
    """Rows with left and right side by side, numbered."""
    known = {f"{found['name']}_left": (found["value"], found["real"]) for found in differences}
    grouped: dict[str, list[dict[str, Any]]] = {}
    for row in table:
        grouped.setdefault(row["words"], []).append(row)
    return [
        _Entry(
            number,
            words,
            tuple(row["name"] for row in group),
            tuple((row["side"], row["value"], _half(row), mark_of(row)) for row in group),
            next((known[row["name"]] for row in group if row["name"] in known), None),
        )
        for number, (words, group) in enumerate(grouped.items(), start=1)
    ]


def _half(row: dict[str, Any]) -> float:
    return 0.0 if row["value"] is None else (row["high"] - row["low"]) / 2


def _head(canvas: Canvas, scan: ScanRecord, pose: Pose, unit: Unit, language: Language) -> None:
    words = _WORDS[language]
    verdict = verdict_words(scan.verdict, language).upper()
    width = _width(verdict, 22, bold=True) + 24
    colour = _COLOURS.get(scan.verdict, _GREY)
    canvas.setFillColor(colour)
    canvas.roundRect(_WIDTH - _MARGIN - width, _HEIGHT - 66, width, 34, 5, stroke=0, fill=1)
    _text(
        canvas, _WIDTH - _MARGIN - width + 12, _HEIGHT - 57, verdict, 22, HexColor("#ffffff"), True
    )
    room = _WIDTH - 2 * _MARGIN - width - 16
    label = _cut(scan.label or words["unlabelled"], room, 20, bold=True)
    _text(canvas, _MARGIN, _HEIGHT - 52, label, 20, _INK, True)
    moment = scan.created.replace("T", "  ").removesuffix("Z") + " UTC"
    facts = [moment, scan.scan_id, scan.booth, words[pose], unit]
    _text(canvas, _MARGIN, _HEIGHT - 68, "   ·   ".join(filter(None, facts)), 8.5, _GREY)
    for number, line in enumerate(_lines(in_language("; ".join(scan.reasons), language))):
        _text(canvas, _MARGIN, _HEIGHT - 79 - 8 * number, line, _REASONS_SIZE, colour)
    canvas.setStrokeColor(_RULE)
    canvas.line(_MARGIN, _HEIGHT - 99, _WIDTH - _MARGIN, _HEIGHT - 99)


def _cut(text: str, room: float, size: float, *, bold: bool = False) -> str:
    """A text, cut to the width that it has."""
    if len(text) > _MOST_LETTERS:
        text = text[: _MOST_LETTERS - 1] + "…"
    while len(text) > 4 and _width(text, size, bold) > room:
        text = text[:-2] + "…"
    return text


def _lines(reasons: str) -> list[str]:
    """The head's lines of reasons, broken between words; Chinese has spaces only around numbers."""
    room, lines = _WIDTH - 2 * _MARGIN, list[str]()
    while len(lines) < _REASONS_LINES and (line := _cut(reasons, room, _REASONS_SIZE)):
        if line != reasons and len(lines) < _REASONS_LINES - 1:
            end = reasons.rfind(" ", len(line) // 2, len(line))
            line = reasons[: end if end > 0 else len(line) - 1]
        lines.append(line)
        reasons = reasons[len(line) :].lstrip()
    return lines


def _figures(
    canvas: Canvas, views: Sequence[View], entries: Sequence[_Entry], language: Language
) -> None:
    tallest = max(view.height_m for view in views)
    total = sum(view.width_m for view in views)
    room = (_WIDTH - 2 * _MARGIN - 6 * 20.0) / total
    scale = min((_FIGURE_HEIGHT - 16) / tallest, room)
    gap = (_WIDTH - 2 * _MARGIN - scale * total) / len(views)
    best = {entry.number: _best_view(entry, views) for entry in entries}
    left = _MARGIN
    for view in views:
        x, width = left + gap / 2, scale * view.width_m
        mine = [entry for entry in entries if best[entry.number] == view.side]
        _figure(canvas, view, mine, x, scale)
        name = _WORDS[language][view.side]
        middle = x + width / 2 - _width(name, 7.5) / 2
        _text(canvas, middle, _FIGURE_TOP - scale * tallest - 14, name, 7.5, _GREY)
        left += gap + width


def _best_view(entry: _Entry, views: Sequence[View]) -> str:
    """The side from which most of its lines are seen; of hidden ones, where they are longest."""

    def seen(view: View) -> tuple[float, float]:
        pieces = [piece for name in entry.names for piece in view.lines[name]]
        whole = [view.whole[name] for name in entry.names]
        return sum(map(_length, pieces)), sum(map(_length, whole))

    return max(views, key=seen).side


def _length(piece: Line) -> float:
    steps = pairwise(piece)
    return float(sum(((x - u) ** 2 + (z - w) ** 2) ** 0.5 for (x, z), (u, w) in steps))


def _figure(canvas: Canvas, view: View, entries: Sequence[_Entry], x: float, scale: float) -> None:
    width, height = scale * view.width_m, scale * view.height_m
    picture = ImageReader(Image.fromarray(view.picture))
    canvas.drawImage(picture, x, _FIGURE_TOP - height, width, height)

    def at(spot: tuple[float, float]) -> tuple[float, float]:
        return (
            x + scale * (spot[0] - view.left_m),
            _FIGURE_TOP + scale * (spot[1] - view.top_m),
        )

    canvas.setStrokeColor(_LINE)
    canvas.setLineWidth(0.55)
    labels: list[tuple[float, float, int, bool]] = []
    for entry in entries:
        spots = []
        pieces = [piece for name in entry.names for piece in view.lines[name]]
        hidden = not pieces
        if hidden:
            pieces = [view.whole[name] for name in entry.names if view.whole[name]]
        canvas.setDash(*([1.6, 1.6], 0) if hidden else ())
        for piece in pieces:
            path = canvas.beginPath()
            path.moveTo(*at(piece[0]))
            for spot in piece[1:]:
                path.lineTo(*at(spot))
            canvas.drawPath(path)
            spots += [at(spot) for spot in piece]
        if spots:
            on_left = len(labels) % 2 == 0
            spot = min(spots) if on_left else max(spots)
            labels.append((*spot, entry.number, on_left))
    canvas.setDash()
    for on_left in (True, False):
        _numbers(canvas, [label for label in labels if label[3] == on_left], x, width, on_left)


def _numbers(
    canvas: Canvas,
    labels: Sequence[tuple[float, float, int, bool]],
    x: float,
    width: float,
    on_left: bool,
) -> None:
    """Numbers in a column beside the body, without overlap, each with a thin leader line."""
    edge = x - 14 if on_left else x + width + 6
    below = _FIGURE_TOP + 8
    canvas.setLineWidth(0.25)
    canvas.setStrokeColor(_RULE)
    for spot_x, spot_y, number, _ in sorted(labels, key=lambda label: -label[1]):
        y = min(spot_y - 2, below - 7.5)
        below = y
        canvas.line(edge + (9 if on_left else -1), y + 2, spot_x, spot_y)
        _text(canvas, edge, y, str(number), 6.2, _INK)


def _table(canvas: Canvas, entries: Sequence[_Entry], unit: Unit, language: Language) -> None:
    words, digits = _WORDS[language], DIGITS[unit]
    half = (len(entries) + 1) // 2
    width = (_WIDTH - 2 * _MARGIN - 18) / 2
    top = _FIGURE_TOP - _FIGURE_HEIGHT - 16
    step = min(_ROW_HEIGHT, (top - 40) / half)
    for column, chunk in enumerate((entries[:half], entries[half:])):
        left = _MARGIN + column * (width + 18)
        for offset, title in (
            (width - 92, f"{words['value']} / {words['l']}"),
            (width - _DIFFERENCE, words["difference"]),
            (width - 2, words["r"]),
        ):
            _text(canvas, left + offset - _width(title, 6.5), top + 2, title, 6.5, _GREY)
        for index, entry in enumerate(chunk):
            y = top - (index + 1) * step + 3
            canvas.setStrokeColor(_RULE)
            canvas.setLineWidth(0.3)
            canvas.line(left, y - 3, left + width, y - 3)
            _text(canvas, left, y, str(entry.number), 6.5, _GREY)
            _text(canvas, left + 15, y, entry.words, 7.6, _INK)
            if entry.difference is not None:
                less, real = entry.difference
                text = f"{less:+.{digits}f}"
                right = left + width - _DIFFERENCE
                _text(canvas, right - _width(text, 6.8, real), y, text, 6.8, _INK, real)
            for side, value, around, mark in entry.values:
                right = left + width - (2 if side == "right" else 92)
                if value is None:
                    _text(canvas, right - 28 - _width("–", 8.2, True), y, "–", 8.2, _GREY, True)
                    continue
                about = f"± {around:.{digits}f}"
                _text(canvas, right - _width(about, 6.2), y, about, 6.2, _GREY)
                _text(canvas, right + 1, y, mark, 6.2, _INK)
                text = f"{value:.{digits}f}"
                _text(canvas, right - 28 - _width(text, 8.2, True), y, text, 8.2, _INK, True)


def _text(
    canvas: Canvas, x: float, y: float, text: str, size: float, colour: Any, bold: bool = False
) -> None:
    """Text of any script, each stretch in a font that has it."""
    canvas.setFillColor(colour)
    for font, run in _runs(text, bold):
        canvas.setFont(font, size)
        canvas.drawString(x, y, run)
        x += pdfmetrics.stringWidth(run, font, size)


def _width(text: str, size: float, bold: bool = False) -> float:
    return float(sum(pdfmetrics.stringWidth(run, font, size) for font, run in _runs(text, bold)))


def _runs(text: str, bold: bool) -> Iterator[tuple[str, str]]:
    fonts = _fonts()
    run, last = "", ""
    for character in text:
        font = _font_of(character, bold, fonts)
        if font != last and run:
            yield last, run
            run = ""
        run, last = run + (character if font else "?"), font or _LATIN
    if run:
        yield last, run


def _font_of(character: str, bold: bool, fonts: frozenset[str]) -> str:
    if ord(character) < 256 or character in "…–—‘’“”•€":
        return _BOLD if bold else _LATIN
    if _OTHER in fonts:
        return _OTHER
    return _CHINESE if ord(character) >= 0x2E80 else ""


@lru_cache(maxsize=1)
def _fonts() -> frozenset[str]:
    """Fonts beside the two that every PDF reader has."""
    pdfmetrics.registerFont(UnicodeCIDFont(_CHINESE))
    for path in _OTHER_FILES:
        if path.exists():
            pdfmetrics.registerFont(TTFont(_OTHER, str(path)))
            return frozenset({_CHINESE, _OTHER})
    return frozenset({_CHINESE})
