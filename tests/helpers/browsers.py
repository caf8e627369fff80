"""Headless Chromium without a graphics card, on a machine that may be busy."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import pytest

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
PATIENCE_S = 120.0
"""How long a condition may take to hold where every core is taken by others."""

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None or find_spec("playwright") is None,
    reason="no Chromium: apt-get install chromium; pip install playwright",
)


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser in a new profile folder, which goes with it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS, timeout=1000 * PATIENCE_S
        )
        try:
            yield browser
        finally:
            browser.close()


def new_page(browser: Any, **options: Any) -> Any:
    """A page in a context of its own, which waits as long as a busy machine needs."""
    page = browser.new_context(**options).new_page()
    page.set_default_timeout(1000 * PATIENCE_S)
    return page


def collect_errors(page: Any, errors: list[str], own: Sequence[str]) -> None:
    """Note whatever a page reports as an error, or fetches from elsewhere.

    Args:
        page: before it is opened.
        errors: to add to.
        own: schemes of addresses that the page may fetch, such as "blob".
    """
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on(
        "console",
        lambda message: errors.append(message.text) if message.type == "error" else None,
    )
    page.on(
        "request",
        lambda request: (
            errors.append(request.url) if request.url.split(":")[0] not in own else None
        ),
    )


def wait_until(condition: Callable[[], bool], what: str, page: Any = None) -> None:
    """Return as soon as the condition holds.

    Args:
        condition: asked some twenty times a second.
        what: the sentence of the failure.
        page: whose events are handled meanwhile.
    """
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s: {what}"
        if page is None:
            time.sleep(0.05)
        else:
            page.wait_for_timeout(50)
