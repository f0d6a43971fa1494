"""The loss lab as its reader has it: `skinlib lab` in a real browser.

    SKINLIB_BROWSER=/usr/bin/chromium pytest tests/browser

needs `pip install playwright` and a Chromium. Screenshots are kept in the folder that
SKINLIB_SCREENSHOTS names.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest

BROWSER = os.environ.get("SKINLIB_BROWSER")
pytestmark = pytest.mark.skipif(
    not BROWSER, reason="SKINLIB_BROWSER names no Chromium executable"
)
SCREENSHOTS = os.environ.get("SKINLIB_SCREENSHOTS")
WAIT = 120_000  # ms; the page starts a kernel, which imports torch


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Where `skinlib lab` serves; it ends with Ctrl-C and leaves no kernel."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("lab")
    command = [sys.executable, "-m", "skinlib", "lab", f"--port={port}", "--no-browser"]
    with open(folder / "log", "w") as log:
        server = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)
    for _ in range(600):
        with socket.socket() as knock:
            if knock.connect_ex(("127.0.0.1", port)) == 0:
                break
        assert server.poll() is None, (folder / "log").read_text()
        time.sleep(0.1)
    yield f"http://127.0.0.1:{port}"
    server.send_signal(signal.SIGINT)
    assert server.wait(60) == 0


@pytest.fixture(scope="module")
def page(address):
    """The page when the first picture is there; `page.complaints` is its console."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as browsers:
        browser = browsers.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1400, "height": 1100})
        page.complaints = []
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("console", lambda message: hear(page, message))
        page.goto(address, timeout=WAIT)
        page.wait_for_selector("text=paused", timeout=WAIT)
        yield page
        browser.close()


def hear(page, message) -> None:
    # Voila's page asks a CDN for icons, which a machine without a network lacks.
    elsewhere = "://127.0.0.1" not in message.location.get("url", "")
    if message.type == "error" and not elsewhere:
        page.complaints.append(message.text)


def steps(page) -> int:
    return int(re.search(r"step (\d+)", page.inner_text("text=/step \\d+/"))[1])


def press(page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def wait_for_steps(page, count: int) -> None:
    limit = time.monotonic() + WAIT / 1000
    while steps(page) < count:
        assert time.monotonic() < limit, f"{steps(page)} steps, not {count}"
        page.wait_for_timeout(200)


def pictures(page) -> list[str]:
    """What the page shows, a hash each."""
    return page.eval_on_selector_all(
        "img.widget-image, .widget-image img",
        """async images => Promise.all(images.map(async image => {
            const data = await (await fetch(image.src)).arrayBuffer();
            const hash = await crypto.subtle.digest("SHA-1", data);
            return String(new Uint8Array(hash));
        }))""",
    )


def shoot(page, name: str) -> None:
    if SCREENSHOTS:
        page.screenshot(path=f"{SCREENSHOTS}/{name}.png", full_page=True)


def test_a_run_in_the_browser(page):
    assert steps(page) == 0 and len(pictures(page)) == 2
    shoot(page, "1_start")
    before = pictures(page)

    press(page, "Run")
    wait_for_steps(page, 10)
    assert all(now != then for now, then in zip(pictures(page), before, strict=True))

    # A slider is moved, by keys, while the run goes on.
    handle = page.locator(".noUi-handle").first
    handle.focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    assert float(handle.get_attribute("aria-valuenow")) == pytest.approx(1.2)
    wait_for_steps(page, steps(page) + 5)
    shoot(page, "2_running")

    press(page, "Pause")
    page.wait_for_selector("text=paused", timeout=WAIT)
    held, shown = steps(page), pictures(page)
    page.wait_for_timeout(1500)
    assert steps(page) == held and pictures(page) == shown

    press(page, "Step")
    wait_for_steps(page, held + 1)
    assert steps(page) == held + 1

    # Kept as the reference, a new run beside it, in other colours, the jaw open.
    press(page, "Keep")
    page.wait_for_selector("text=/step 0\\b/", timeout=WAIT)
    page.get_by_label("show").select_option("error")
    jaw = page.locator(".noUi-handle").last
    jaw.focus()
    for _ in range(8):
        page.keyboard.press("ArrowRight")
    press(page, "Run")
    wait_for_steps(page, 8)
    press(page, "Pause")
    page.wait_for_selector("text=paused", timeout=WAIT)
    shoot(page, "3_reference")

    # Saved and opened again.
    press(page, "Save")
    page.wait_for_selector("text=saved in", timeout=WAIT)
    kept = steps(page)
    press(page, "Reset")
    page.wait_for_selector("text=/step 0\\b/", timeout=WAIT)
    press(page, "Open")
    wait_for_steps(page, kept)
    assert page.complaints == []
