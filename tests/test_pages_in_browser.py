"""Pages in headless Chromium: no error, no network, and what a user moves changes the flight."""

import json
import os
import shutil
from pathlib import Path

import pytest

pytest.importorskip("playwright.sync_api", reason="needs playwright and its Chromium")

from playwright.sync_api import Error, sync_playwright  # noqa: E402

import evaluate  # noqa: E402

ROOT = Path(__file__).parents[1]
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser():
    """Playwright's Chromium, or the system's; skipped without one, but not where a workflow counts on it."""
    with sync_playwright() as playwright:
        try:
            found = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        except Error as error:
            if "GITHUB_ACTIONS" in os.environ:
                raise
            pytest.skip(f"no Chromium: {str(error).splitlines()[0]}")
        yield found
        found.close()


@pytest.fixture
def opened(browser, tmp_path):
    """A function that opens a result's page; at the end nothing was loaded but the file, and no error was said."""
    said, asked = [], []

    def load(result):
        file = evaluate.page(ROOT / "results" / result, tmp_path / "page.html")
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(file.as_uri())
        page.wait_for_selector("#end td, #readings td", state="attached")
        return page

    yield load
    assert [url for url in asked if not url.startswith("data:")] == [(tmp_path / "page.html").as_uri()]
    assert said == []


def move(page, slider, value):
    """Move a slider, and wait until all has flown."""
    before = page.inner_text("#end")
    page.evaluate(f"document.getElementById('{slider}').value = {value}")
    page.dispatch_event(f"#{slider}", "input")
    page.wait_for_function("before => document.getElementById('end').innerText !== before", arg=before)


def errors(page):
    """||error|| of policy, optimum, open loop and LQR, as they stand in the table."""
    return [float(cell) for cell in page.inner_text("#end tr:first-child").split()[1:5]]


def test_a_rockets_page(opened):
    page = opened("rocket_dispersed")
    metrics = json.loads((ROOT / "results" / "rocket_dispersed" / "eval.json").read_text())
    at_first = errors(page)
    assert at_first[0] == pytest.approx(metrics["error_norm"], abs=1e-6)
    assert page.locator("#scene canvas").count() == 1

    move(page, "thrust", 1)
    policy, optimum, open_loop, _ = errors(page)
    assert policy != at_first[0] and optimum == at_first[1] and open_loop > 100 * at_first[2]
    assert "+1.0 % = +2.0 σ" in page.inner_text("#sliders")
    page.click("#reset")
    page.wait_for_function("() => page.flights.openLoop.errorNorm < 1e-4")
    assert errors(page) == at_first

    page.evaluate("page.show(400)")
    before = page.inner_text("#end")
    page.click("#fail")
    page.wait_for_function("before => document.getElementById('end').innerText !== before", arg=before)
    assert "10 % of thrust and flow lost from 400.0 s on" in page.inner_text("#failure")
    assert errors(page)[2] > 0.01


def test_a_page_of_any_orbit(opened):
    """The policy flies to where the sliders stand, and the target's ellipse moves along."""
    page = opened("rocket_any_orbit")
    metrics = json.loads((ROOT / "results" / "rocket_any_orbit" / "eval.json").read_text())
    assert float(page.inner_text("#end tr:first-child").split()[1]) == pytest.approx(metrics["error_norm"], abs=1e-6)
    ellipse = page.evaluate("Array.from(page.scene.target.geometry.attributes.position.array)")
    move(page, "i", 36)
    move(page, "apogee", 8.0)
    policy = float(page.inner_text("#end tr:first-child").split()[1])
    assert policy < 0.005
    rows = dict(line.split("\t", 1) for line in page.inner_text("#end").splitlines())
    flown, _, target = map(float, rows["inclination (°)"].split())
    assert target == 36.0 and flown == pytest.approx(36.0, abs=0.05)
    assert page.evaluate("Array.from(page.scene.target.geometry.attributes.position.array)") != ellipse
    page.select_option("#stored", "5")
    page.wait_for_function("() => document.getElementById('nearest').innerText.endsWith('of this orbit.')")
    page.click("#reset")
    page.wait_for_function("() => page.changes.target === null && page.rocket === page.data.rocket")


def test_time_runs_and_views_change(opened):
    page = opened("two_stage_leo")
    page.select_option("#speed", "100")
    page.click("#play")
    page.wait_for_function("() => page.time > 20")
    page.click("#play")
    place = page.evaluate("page.scene.camera.position.toArray()")
    page.click("[data-view=orbit]")
    assert page.get_attribute("[aria-pressed=true]", "data-view") == "orbit"
    assert page.evaluate("page.scene.camera.position.toArray()") != place
    assert float(page.inner_text("#clock").split()[0]) == pytest.approx(page.evaluate("page.time"), abs=0.06)


@pytest.mark.parametrize("result", ["di", "vdp_waypoints"])
def test_a_start_is_dragged(opened, result):
    page = opened(result)
    before = page.inner_text("#readings")
    box = page.locator("#plane").bounding_box()
    x, y = page.evaluate("page.plane.pixel(...page.start)")
    page.mouse.move(box["x"] + x, box["y"] + y)
    page.mouse.down()
    x, y = page.evaluate("page.plane.pixel(0.6, 0.4)")
    page.mouse.move(box["x"] + x, box["y"] + y, steps=3)
    page.mouse.up()
    page.wait_for_function("() => Math.abs(page.start[0] - 0.6) < 0.01 && page.policy.x[0] === page.start")
    assert page.inner_text("#readings") != before
    cost, optimum = page.evaluate("[page.policy.cost, page.optimum.cost]")
    assert optimum < cost < 1.1 * optimum
    assert f"{cost:.6f}" in page.inner_text("#readings")
