"""A page as a reader's browser shows it: headless Chromium, without a network, on a phone and a desk, in light and dark."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
"""Options of Chromium: no network of its own, and no sandbox, which root may not have."""
WIDTHS = {"phone": 390, "desk": 1280}
SCHEMES = ("light", "dark")
LOOK = """() => {
  const lightness = (color) => {
    const parts = color.match(/[\\d.]+/g).slice(0, 3).map((v) => v / 255);
    const [r, g, b] = parts.map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = lightness(getComputedStyle(document.body).backgroundColor);
  const contrast = (color) => {
    const [a, b] = [ground, lightness(color)].sort((x, y) => y - x);
    return (a + 0.05) / (b + 0.05);
  };
  document.querySelectorAll("details").forEach((d) => (d.open = true));
  const texts = [...document.querySelectorAll("p, li, td span, th, figcaption, dt, dd, summary, svg text")];
  const seen = texts.filter((e) => e.textContent.trim() && e.getClientRects().length);
  const paint = (e) => (e.namespaceURI.endsWith("svg") ? getComputedStyle(e).fill : getComputedStyle(e).color);
  const scale = (e) => { const m = e.getScreenCTM?.(); return m ? Math.sqrt(Math.abs(m.a * m.d - m.b * m.c)) : 1; };
  return {
    overflow: document.documentElement.scrollWidth - window.innerWidth,
    broken: [...document.images].filter((i) => !i.complete || i.naturalWidth === 0).length,
    images: document.images.length,
    charts: [...document.querySelectorAll("svg")].map((s) => s.getBoundingClientRect().width),
    smallest: Math.min(...seen.map((e) => scale(e) * parseFloat(getComputedStyle(e).fontSize))),
    contrast: Math.min(...seen.map((e) => contrast(paint(e)))),
    dark: ground < 0.5,
    tables: [...document.querySelectorAll("td .mean")].filter((e) => e.getBoundingClientRect().width === 0).length,
    sideways: [...document.querySelectorAll(".wide")].filter((e) => e.scrollWidth > e.clientWidth).length,
    spilt: [...document.querySelectorAll(".claim li span")].filter(
      (e) => e.getBoundingClientRect().right > e.closest("div").getBoundingClientRect().right + 1).length,
  };
}"""
"""Everything folded is opened first. Sizes are of text as it stands on the screen, in pixels."""


@dataclass(frozen=True)
class Sight:
    """What was found at one width and color scheme."""

    complaints: tuple[str, ...]
    """Of the console, of scripts, and requests that failed or left the machine."""
    overflow: float
    """Pixels by which the page is wider than the window."""
    broken: int
    """Images that did not load, ..."""
    images: int
    """... of how many."""
    charts: tuple[float, ...]
    """Widths of inline charts."""
    smallest: float
    """Size of the smallest text."""
    contrast: float
    """Lowest contrast of a text with the page's ground (WCAG 2)."""
    dark: bool
    tables: int
    """Values of tables that have no width."""
    sideways: int
    """Tables that have to be moved sideways to be read whole."""
    spilt: int
    """Numbers of claims that run into the next column."""


def look_at(page: Path, shots: Path | None = None) -> dict[tuple[str, str], Sight]:
    """Open a page by itself (file://, offline) at every width and scheme; `shots` is a folder for screenshots."""
    found = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS])
        for name, width in WIDTHS.items():
            for scheme in SCHEMES:
                context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True)
                tab, complaints = context.new_page(), list[str]()
                tab.on("console", lambda message, kept=complaints: kept.append(message.text))
                tab.on("pageerror", lambda error, kept=complaints: kept.append(str(error)))
                tab.on("request", lambda r, kept=complaints: kept.extend([r.url] * (not r.url.startswith(("file:", "data:")))))
                tab.on("requestfailed", lambda request, kept=complaints: kept.append(request.url[:100]))
                tab.goto(page.resolve().as_uri())
                sight = tab.evaluate(LOOK)
                found[name, scheme] = Sight(tuple(complaints), **{**sight, "charts": tuple(sight["charts"])})
                if shots:
                    tab.screenshot(path=shots / f"{page.parent.name}_{name}_{scheme}.png")
                context.close()
        browser.close()
    return found


def find_faults(page: Path, images: int, charts: int) -> list[str]:
    """What keeps a page from showing itself whole, on a phone and a desk, in light and dark.

    Args:
        page: index.html.
        images, charts: how many it has.
    """
    faults = []
    for (width, scheme), sight in look_at(page).items():
        right = {
            "complaints": not sight.complaints,
            "overflow": sight.overflow <= 0,
            "images": (sight.broken, sight.images) == (0, images),
            "charts": len(sight.charts) == charts and all(wide > 250 for wide in sight.charts),
            "smallest": sight.smallest >= 9.5,
            "contrast": sight.contrast >= 4.5,
            "dark": sight.dark == (scheme == "dark"),
            "tables": sight.tables == 0,
            "spilt": sight.spilt == 0,
            "sideways": sight.sideways == 0 or width == "phone",
        }
        faults += [f"{width}, {scheme}: {name} is {getattr(sight, name)}" for name, holds in right.items() if not holds]
    return faults
