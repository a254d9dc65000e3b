"""The site: all that is public is described, and what a reader sees of it is whole.

The last test needs `playwright`, and a browser: playwright's own (``playwright install chromium``)
or the one whose path is in ``CHROMIUM``.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from html.parser import HTMLParser
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import pytest

import torchrl_ecpo
from torchrl_ecpo.trainers import LossConfig

ROOT = Path(__file__).parents[1]
API = ROOT / "docs/api"
MODULES = [
    "torchrl_ecpo",
    *(
        module.name
        for module in pkgutil.walk_packages(torchrl_ecpo.__path__, "torchrl_ecpo.")
        if "._" not in module.name
    ),
]
PUBLIC = {
    name: getattr(module, name)
    for module in map(importlib.import_module, MODULES)
    for name in getattr(module, "__all__", ())
}
CLASSES = [
    found
    for found in PUBLIC.values()
    # Configs are made of the losses, and have their options.
    if inspect.isclass(found) and not issubclass(found, LossConfig)
]
RECORDS = (tuple, SimpleNamespace)  # they check nothing


def test_a_public_class_has_an_example_and_says_what_it_raises():
    assert [kind for kind in CLASSES if "Examples:\n" not in (kind.__doc__ or "")] == []
    silent = [kind for kind in CLASSES if "Raises:\n" not in (kind.__doc__ or "")]
    assert [k for k in silent if not (issubclass(k, RECORDS) or dataclasses.is_dataclass(k))] == []


class Page(HTMLParser):
    """What a page links to, its anchors, and its text outside of code and scripts."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.text = ""
        self._inside: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors |= {found["id"]} if found.get("id") else set()
        self.links += [found[key] for key in ("href", "src") if found.get(key)]
        is_maths = "math" in (found.get("class") or "").split()
        if tag in ("code", "pre", "script", "style") or is_maths:
            self._inside.append(tag)

    def handle_endtag(self, tag):
        if self._inside and tag == self._inside[-1]:
            self._inside.pop()

    def handle_data(self, data):
        self.text += "" if self._inside else data


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", ROOT / "docs", folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return {path.resolve(): Page(path) for path in site.rglob("*.html")}


@pytest.mark.slow
def test_every_public_name_is_on_a_page_of_the_api(site, pages):
    anchors = {a for path, page in pages.items() if "api" in path.parts for a in page.anchors}
    described = {anchor.rpartition(".")[2] for anchor in anchors}
    assert set(PUBLIC) - described == set()


@pytest.mark.slow
def test_no_link_is_dead_and_nothing_comes_from_elsewhere(site, pages):
    dead = set()
    for path, page in pages.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme or address.netloc:
                if link.endswith((".js", ".css")):
                    dead.add((path.name, link))  # a reader without the internet lacks it
                continue
            target = (path.parent / unquote(address.path)).resolve() if address.path else path
            fragment = unquote(address.fragment)
            is_there = target.exists()
            if is_there and target.suffix == ".html" and fragment:
                # A listing's way back leads to the page alone, if the module has two names there.
                is_there = "_modules" in path.parts or fragment in pages[target].anchors
            if not is_there:
                dead.add((path.name, link))
    assert dead == set()


@pytest.mark.slow
def test_no_formula_is_shown_as_it_is_written(pages):
    for path, page in pages.items():
        assert not re.search(r"\\(?:frac|sum|tau|pi|log|mathrm|bar)\b|\$\$", page.text), path


SEEN = """() => {
    const width = document.documentElement.clientWidth;
    const scrolled = element => {
        for (let above = element.parentElement; above; above = above.parentElement)
            if (getComputedStyle(above).overflowX != "visible") return true;
        return false;
    };
    const wide = [...document.querySelectorAll("article *")].filter(
        element => element.getBoundingClientRect().right > width + 1 && !scrolled(element));
    return {
        wide: wide.map(element => element.outerHTML.slice(0, 80)),
        sideways: document.documentElement.scrollWidth - width,
        unset: document.querySelectorAll(".math").length
            - document.querySelectorAll("mjx-container").length,
        wrong: document.querySelectorAll("mjx-merror").length,
        empty: [...document.images].filter(image => !image.naturalWidth).map(image => image.src),
    };
}"""
WHOLE = {"wide": [], "sideways": 0, "unset": 0, "wrong": 0, "empty": []}
SET = "!document.querySelector('.math') || document.querySelector('mjx-container')"


@pytest.mark.slow
def test_pages_are_whole_on_a_desk_and_on_a_phone_by_day_and_by_night(site, tmp_path):
    """Nothing sticks out, every formula is set, every picture is there; nothing is asked elsewhere.

    Screenshots of what is seen first are in ``tmp_path``.
    """
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        path = os.environ.get("CHROMIUM") or playwright.chromium.executable_path
        if not Path(path).is_file():
            pytest.skip(f"no browser at {path}: run playwright install chromium, or set CHROMIUM")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page(offline=True)
        page.set_default_timeout(120_000)  # a busy machine takes its time
        seen = {}
        for file in sorted(site.rglob("*.html")):
            name = str(file.relative_to(site))
            if name.startswith("_"):  # listings of code
                continue
            page.goto(file.as_uri())
            page.wait_for_function(SET)
            for width, scheme in product((1400, 390), ("light", "dark")):
                page.set_viewport_size({"width": width, "height": 900})
                page.emulate_media(color_scheme=scheme)
                shot = f"{name.replace('/', '_')}_{width}_{scheme}.png"
                page.screenshot(path=tmp_path / shot)
                seen[shot] = page.evaluate(SEEN)
        browser.close()
    assert seen == dict.fromkeys(seen, WHOLE)
