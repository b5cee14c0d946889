"""The site in a real browser.

``pytest docs/test_site.py`` runs it after ``sphinx-build docs docs/_build``. It needs Playwright
from PyPI, and Chromium as ``chromium`` on the path, as Debian names it.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

SITE = Path(__file__).parent / "_build"
SCENES = Path(__file__).parents[1] / "scenes"
PAGES = (
    "index",
    "gallery",
    "other_names",
    "plugins/glint_manifold",
    "reports/error_vs_time",
    "reports/stability",
    "tutorials/own_map",
)
WIDTHS = (1300, 400)  # pixels: a desk and a phone

# What reaches beyond the page, unless it is in a box of its own that scrolls or hides it.
TOO_WIDE = """() => {
  const scrolls = e => e && (getComputedStyle(e).overflowX !== "visible"
                             || getComputedStyle(e).position === "fixed"
                             || scrolls(e.parentElement));
  return [...document.querySelectorAll("body *")]
    .filter(e => e.getBoundingClientRect().width > 0
                 && e.getBoundingClientRect().right > innerWidth + 1
                 && getComputedStyle(e).position !== "fixed" && !scrolls(e.parentElement))
    .map(e => e.outerHTML.slice(0, 80));
}"""

# Cells in which a word does not fit, so that it is broken into letters.
SQUEEZED = """() => [...document.querySelectorAll("td, th")]
  .filter(e => e.clientWidth > 0 && Math.max(...e.innerText.split(/[^\\p{L}\\p{N}]+/u).map(
    word => word.length)) * 4.5 > e.clientWidth)
  .map(e => `${e.clientWidth} px: ${e.innerText.trim().slice(0, 40)}`)"""

MISSING_IMAGES = """() => [...document.images]
  .filter(e => !e.complete || e.naturalWidth === 0).map(e => e.src)"""


class Handler(SimpleHTTPRequestHandler):
    """Serves files, and tells nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The site's address on this machine."""
    assert (SITE / "index.html").exists(), "first run: sphinx-build docs docs/_build"
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(SITE))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    assert chromium, 'Chromium is not installed; on Debian: "apt-get install chromium"'
    # Chromium refuses to set up its sandbox for root, and looks up its maker's hosts as it starts.
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    switches = ["--disable-background-networking", *["--no-sandbox"] * root]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=switches)
        yield browser
        browser.close()


def opened(browser: Browser, address: str, name: str, width: int) -> tuple[Page, list[str]]:
    """A page as a window of a width shows it, and all that went wrong."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    wrong: list[str] = []
    page.on("console", lambda told: wrong.append(f"{told.type}: {told.text}"))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("requestfailed", lambda request: wrong.append(f"failed: {request.url}"))
    page.on("request", lambda request: wrong.append(request.url) if foreign(request.url) else None)
    page.goto(f"{address}/{name}.html", wait_until="networkidle")
    return page, wrong


def foreign(url: str) -> bool:
    """Whether a request leaves this machine."""
    return not url.startswith(("http://127.0.0.1", "data:", "blob:"))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_page(browser, address, name, width):
    page, wrong = opened(browser, address, name, width)
    assert page.evaluate("innerWidth") == width
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(TOO_WIDE) == []
    assert page.evaluate(SQUEEZED) == []
    assert page.evaluate("document.querySelector('h1').innerText.trim()")
    assert page.evaluate(MISSING_IMAGES) == []
    assert wrong == []
    page.close()


def test_gallery_shows_every_scene_beside_its_file(browser, address):
    page, _ = opened(browser, address, "gallery", 1300)
    shown = set()
    for figure in page.locator(".gallery figure").all():
        assert figure.locator("img").count() == 1
        (file,) = (link for link in hrefs(figure) if link.endswith(".xml"))
        assert page.request.get(f"{address}/{file}").ok
        assert any(link.startswith("plugins/") for link in hrefs(figure))
        shown.add(file.split("/")[-1])
    assert shown == {path.name for path in SCENES.glob("*.xml")}
    page.close()


def hrefs(element) -> list[str]:
    return [link.get_attribute("href") for link in element.locator("a").all()]


def test_mathematics_is_set(browser, address):
    page, _ = opened(browser, address, "plugins/glint_manifold", 1300)
    assert page.locator("mjx-container").count() > 0
    page.close()
