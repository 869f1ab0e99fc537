"""Write docs/page.png, the picture of a flight in the browser on the front page.

    python docs/page_picture.py

It needs the package playwright, and its Chromium (`playwright install chromium`) or the system's.
"""

import shutil
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import evaluate  # noqa: E402

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
CHANGES = {"apogee": 8.7, "i": 37, "perigee": 220}  # log km, degrees, km


def draw(target: Path):
    """Open the page of results/rocket_any_orbit, move the sliders to CHANGES, look at the orbit and take a picture."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = evaluate.page(ROOT / "results" / "rocket_any_orbit", Path(folder) / "page.html")
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 795})
        page.goto(file.as_uri())
        page.wait_for_selector("#end td", state="attached")
        for slider, value in CHANGES.items():
            page.evaluate(f"document.getElementById('{slider}').value = {value}")
            page.dispatch_event(f"#{slider}", "input")
            page.wait_for_timeout(1000)  # ms, until the policy has flown
        page.click("[data-view=orbit]")
        page.evaluate("page.show(page.end)")
        page.wait_for_timeout(500)
        page.screenshot(path=target)
        browser.close()


if __name__ == "__main__":
    draw(ROOT / "docs" / "page.png")
