"""The sliders in a real JupyterLab, moved by a real browser.

    SKINLIB_BROWSER=/usr/bin/chromium pytest tests/browser

needs `pip install jupyterlab playwright` and a Chromium. Screenshots are kept in the
folder that SKINLIB_SCREENSHOTS names.
"""

import json
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import nbformat
import pytest

BROWSER = os.environ.get("SKINLIB_BROWSER")
pytestmark = pytest.mark.skipif(
    not BROWSER, reason="SKINLIB_BROWSER names no Chromium executable"
)

CELLS = {
    "pose": """
from skinlib.datasets.synthetic import synthetic_head
from skinlib.views.widgets import bone_picker, pose_sliders
head = synthetic_head(3)
pose_sliders(head)
""",
    "bone": "bone_picker(head)",
    "press": """
from skinlib.views.garments import press_lab
press_lab()
""",
}
RUN_ALL = """async () => {
    const widget = jupyterapp.shell.currentWidget;
    await widget.context.ready;
    await widget.sessionContext.ready;
    const kernel = widget.sessionContext.session.kernel;
    await kernel.info;
    while (kernel.connectionStatus !== 'connected')
        await new Promise(done => setTimeout(done, 100));
    jupyterapp.commands.execute('notebook:run-all-cells');
}"""
ERRORS = """() => jupyterapp.shell.currentWidget.content.widgets
    .flatMap(cell => cell.model.type === 'code' ? cell.model.outputs.toJSON() : [])
    .filter(output => output.output_type === 'error' || output.name === 'stderr')"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The address of a JupyterLab with one notebook, in folders of its own."""
    folder = tmp_path_factory.mktemp("lab")
    cells = [nbformat.v4.new_code_cell(code.strip()) for code in CELLS.values()]
    notebook = nbformat.v4.new_notebook(cells=cells)
    notebook.metadata.kernelspec = {"name": "python3", "display_name": "Python 3"}
    nbformat.write(notebook, folder / "sliders.ipynb")
    settings = folder / "settings" / "@jupyterlab"
    for plugin, values in {
        "apputils-extension/notification": {"fetchNews": "false"},
        # Cells out of sight are not in the page otherwise.
        "notebook-extension/tracker": {"windowingMode": "none"},
    }.items():
        path = settings / f"{plugin}.jupyterlab-settings"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(values))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(8)
    root = Path(__file__).parents[2]
    server = subprocess.Popen(
        [
            *(sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"),
            *("--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0"),
            *(f"--IdentityProvider.token={token}", f"--ServerApp.root_dir={folder}"),
            "--expose-app-in-browser",
        ],
        env=os.environ
        | {
            "JUPYTERLAB_SETTINGS_DIR": str(folder / "settings"),
            "JUPYTERLAB_WORKSPACES_DIR": str(folder / "workspaces"),
            "PYTHONPATH": os.pathsep.join(
                [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
            ),
        },
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    address = f"http://127.0.0.1:{port}"
    try:
        _wait_for_server(f"{address}/api?token={token}", server)
        yield f"{address}/lab/tree/sliders.ipynb?token={token}"
    finally:
        server.terminate()
        server.wait(20)


def _wait_for_server(address: str, server: subprocess.Popen) -> None:
    for _ in range(120):
        assert server.poll() is None, "JupyterLab has stopped"
        try:
            with urllib.request.urlopen(address, timeout=5):
                return
        except OSError:
            time.sleep(0.5)
    raise TimeoutError(address)


@pytest.fixture(scope="module")
def page(lab):
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1300, "height": 2200})
        page.goto(lab)
        page.wait_for_function(
            "window.jupyterapp?.shell?.currentWidget", timeout=90_000
        )
        page.evaluate(RUN_ALL)
        page.locator(".widget-image").nth(len(CELLS) - 1).wait_for(timeout=120_000)
        yield page
        browser.close()


def _source(page, lab: int) -> str:
    return page.locator(".widget-image").nth(lab).get_attribute("src")


def _wait_for_new_picture(page, lab: int, old: str) -> None:
    page.wait_for_function(
        "([lab, old]) => document.querySelectorAll('.widget-image')[lab].src !== old",
        arg=[lab, old],
        timeout=20_000,
    )


def _keep(page, name: str) -> None:
    folder = os.environ.get("SKINLIB_SCREENSHOTS")
    if folder:
        page.screenshot(path=str(Path(folder) / f"{name}.png"))


def test_a_slider_moved_by_keys_bends_the_head(page):
    old = _source(page, 0)
    _keep(page, "rest")
    page.locator(".noUi-handle").first.focus()
    for _ in range(14):
        page.keyboard.press("ArrowRight")
    _wait_for_new_picture(page, 0, old)
    page.get_by_text("0.70", exact=True).first.wait_for()
    page.wait_for_timeout(1500)
    _keep(page, "jaw_open")
    assert page.evaluate(ERRORS) == []


def test_a_menu_shows_another_bone(page):
    old = _source(page, 1)
    menu = page.locator(".widget-dropdown select").last
    menu.select_option(index=1)
    _wait_for_new_picture(page, 1, old)
    page.wait_for_timeout(1000)
    _keep(page, "bone")
    assert page.evaluate(ERRORS) == []


def test_steps_push_the_cloth_out_of_the_body(page):
    old = _source(page, 2)
    steps = page.locator(".widget-slider", has_text="steps").last
    steps.locator(".noUi-handle").focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    _wait_for_new_picture(page, 2, old)
    page.wait_for_timeout(1000)
    _keep(page, "press")
    assert page.evaluate(ERRORS) == []
