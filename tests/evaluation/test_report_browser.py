"""A report in headless Chromium: no console error, nothing loaded, a slider that works."""

import shutil

import pytest

from tests.evaluation.report_pages import prediction_page

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None,
    reason="needs chromium and chromedriver (Debian: chromium and chromium-driver)",
)
OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--window-size=1300,900"
)
SHOWN = "return [...document.querySelectorAll('.slider .figure:not([hidden]) img')].map(x => x.alt)"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for option in OPTIONS.split():
        options.add_argument(option)
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('chromium')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


def is_fine(browser):
    """No error on the console, and not one request beyond the page itself."""
    severe = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    loaded = browser.execute_script(
        "return performance.getEntriesByType('resource').map(entry => entry.name)"
    )
    return not severe and not [name for name in loaded if not name.startswith("data:")]


@pytest.fixture(scope="module")
def prediction(browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("prediction") / "report.html"
    path.write_text(prediction_page()[0], encoding="utf-8")
    return path


def test_the_slider_shows_one_trajectory(browser, prediction):
    browser.get_log("browser")
    browser.get(prediction.as_uri())
    assert browser.execute_script(SHOWN) == ["trajectory 0"]
    control = browser.find_element(By.CSS_SELECTOR, ".slider input")
    control.send_keys(Keys.END)
    assert browser.execute_script(SHOWN) == ["trajectory 4"]
    assert browser.find_element(By.CSS_SELECTOR, ".slider output").text == "trajectory 4"
    assert is_fine(browser)


def set_width(browser, width):
    """Set the width of the page; Chromium makes no window narrower than 500 px."""
    screen = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)


@pytest.mark.parametrize("width", [390, 1280])
def test_a_page_does_not_scroll_sideways(browser, prediction, width):
    set_width(browser, width)
    browser.get(prediction.as_uri())
    root = "return document.documentElement.{}"
    inner = browser.execute_script(root.format("clientWidth"))
    assert browser.execute_script(root.format("scrollWidth")) <= inner
    assert browser.find_element(By.CSS_SELECTOR, ".slider").size["width"] <= inner
    table = "const t = document.querySelector('.table'); return t.scrollWidth - t.clientWidth"
    assert width < 1280 or browser.execute_script(table) <= 0
