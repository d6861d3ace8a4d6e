"""A page as a browser prints it: the text of each sheet of Chromium's PDF, which has what is cut off no longer in it.

Reads the PDFs that Chromium writes, and no others: objects one after another, fonts of two-byte glyphs with their Unicode.
"""

import re
import zlib
from pathlib import Path

from playwright.sync_api import sync_playwright

from tests.analysis.reports.browser import CHROMIUM

OBJECT = re.compile(rb"(\d+) 0 obj\s(.*?)endobj", re.DOTALL)
STREAM = re.compile(rb"stream\r?\n(.*?)\r?\nendstream", re.DOTALL)
WORD = re.compile(rb"/(\w+) [\d.]+ Tf|<([0-9A-F]+)> Tj|\[([^\]]*)\] TJ")


def print_page(page: Path, sheet: str = "") -> list[str]:
    """Texts of the sheets of a printed page, without white space.

    Args:
        page: an HTML file.
        sheet: size of the paper, such as A4, where it is not left to the page.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_context(offline=True).new_page()
        tab.goto(page.resolve().as_uri())
        printed = tab.pdf(format=sheet) if sheet else tab.pdf(prefer_css_page_size=True)
        browser.close()
    return read_sheets(printed)


def read_sheets(pdf: bytes) -> list[str]:
    """Texts of the pages of one of Chromium's PDFs, in order, without white space."""
    objects = {int(match[1]): match[2] for match in OBJECT.finditer(pdf)}
    (catalog,) = (body for body in objects.values() if b"/Type /Catalog" in body)
    texts = []
    for page in _leaves(objects, _references(catalog, rb"/Pages (\d+ 0 R)")):
        fonts = {
            name: _characters(objects, int(number))
            for listed in re.findall(rb"/Font <<(.*?)>>", page, re.DOTALL)
            for name, number in re.findall(rb"/(\w+) (\d+) 0 R", listed)
        }
        content = _stream(objects[_references(page, rb"/Contents (\d+ 0 R)")[0]])
        texts.append("".join(_words(content, fonts)).translate({ord(space): None for space in " \u00a0\n"}))
    return texts


def _words(content: bytes, fonts: dict[bytes, dict[int, str]]) -> list[str]:
    characters: dict[int, str] = {}
    words = []
    for font, one, several in WORD.findall(content):
        characters = fonts.get(font, {}) if font else characters
        glyphs = b"".join(re.findall(rb"<([0-9A-F]+)>", several)) if several else one
        words.append("".join(characters.get(int(glyphs[i : i + 4], 16), "") for i in range(0, len(glyphs), 4)))
    return words


def _characters(objects: dict[int, bytes], font: int) -> dict[int, str]:
    """Text of each glyph of a font, by its map to Unicode."""
    (number,) = _references(objects[font], rb"/ToUnicode (\d+ 0 R)")
    found = {}
    for kind, lines in re.findall(rb"beginbf(char|range)\n(.*?)endbf", _stream(objects[number]), re.DOTALL):
        for line in lines.splitlines():
            first, *_, text = (value.decode() for value in re.findall(rb"<([0-9A-F]+)>", line))
            last = int(line.split()[1].strip(b"<>"), 16) if kind == b"range" else int(first, 16)
            decoded = bytes.fromhex(text).decode("utf-16-be")
            for step in range(last - int(first, 16) + 1):
                found[int(first, 16) + step] = decoded[:-1] + chr(ord(decoded[-1]) + step)
    return found


def _leaves(objects: dict[int, bytes], nodes: list[int]) -> list[bytes]:
    """The pages below nodes of the tree of pages, in order."""
    found = []
    for body in (objects[number] for number in nodes):
        below = _references(body, rb"/Kids \[(.*?)\]")
        found += _leaves(objects, below) if below else [body]
    return found


def _references(body: bytes, where: bytes) -> list[int]:
    return [int(number) for part in re.findall(where, body, re.DOTALL) for number in re.findall(rb"(\d+) 0 R", part)]


def _stream(body: bytes) -> bytes:
    match = STREAM.search(body)
    assert match is not None
    return zlib.decompress(match[1]) if b"/FlateDecode" in body[: match.start()] else match[1]
