"""Reports in headless Chromium: no console error, nothing loaded, the controls change figures."""

import shutil

import pytest

from tests.evaluation.report_pages import comparisons_of, control_page, prediction_page

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

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
# What is drawn, as pixels along every visible line.
PATHS = (
    "return [...document.querySelectorAll('#{} .scatterlayer path.js-line')]"
    ".map(path => path.getAttribute('d'))"
)


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


class Opened:
    """A page in the browser: its figures by their ids, and what a reader does to them."""

    def __init__(self, browser, path):
        self.browser = browser
        browser.get_log("browser")
        browser.get(path.as_uri())
        self.wait("return document.querySelectorAll('.main-svg').length > 0")

    def wait(self, condition):
        WebDriverWait(self.browser, 20, poll_frequency=0.1).until(
            lambda driver: driver.execute_script(condition)
        )

    def lines(self, figure):
        return self.browser.execute_script(PATHS.format(figure))

    def find(self, figure, selector):
        found = self.browser.find_elements(By.CSS_SELECTOR, f"#{figure} {selector}")
        self.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", found[0])
        return found

    def click(self, figure, selector, index):
        self.find(figure, selector)[index].click()

    def choose(self, figure, text):
        """An entry of the figure's drop-down menu."""
        self.click(figure, ".updatemenu-header", 0)
        self.wait(f"return document.querySelector('#{figure} .updatemenu-dropdown-button')")
        for entry in self.find(figure, ".updatemenu-dropdown-button"):
            if entry.text == text:
                entry.click()
                return
        raise AssertionError(f"the menu of {figure} has no entry {text}")

    def slide(self, figure, part):
        """The slider of the figure to a part of its length."""
        rail = self.find(figure, ".slider-rail-touch-rect")[0]
        across = int((part - 0.5) * rail.size["width"])
        ActionChains(self.browser).move_to_element_with_offset(rail, across, 0).click().perform()

    def changed(self, figure, before):
        self.wait(
            f"return JSON.stringify((() => {{{PATHS.format(figure)}}})()) !== "
            f"JSON.stringify({before!r})".replace("None", "null")
        )
        return self.lines(figure)

    def fine(self):
        """No error on the console, and not one request beyond the page itself."""
        severe = [entry for entry in self.browser.get_log("browser") if entry["level"] == "SEVERE"]
        loaded = self.browser.execute_script(
            "return performance.getEntriesByType('resource').map(entry => entry.name)"
        )
        return not severe and not [name for name in loaded if not name.startswith("data:")]


@pytest.fixture(scope="module")
def prediction(browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("prediction") / "report.html"
    path.write_text(prediction_page(comparisons=comparisons_of(["hnn"]))[0], encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def control(browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("control") / "report.html"
    path.write_text(control_page()[0], encoding="utf-8")
    return path


def test_the_controls_of_an_evaluation_work(browser, prediction):
    page = Opened(browser, prediction)
    assert browser.find_elements(By.CSS_SELECTOR, "td.best")
    labels = [b.get_attribute("data-title") for b in page.find("figure-error", ".modebar-btn")]
    assert labels
    assert not any("hare" in label or "loud" in label for label in labels)

    means = page.lines("figure-error")
    page.click("figure-error", ".updatemenu-button", 1)  # every trajectory
    singles = page.changed("figure-error", means)
    page.click("figure-error", ".updatemenu-button", 3)  # linear
    page.changed("figure-error", singles)
    axis = "return document.getElementById('{}')._fullLayout.{}"
    assert browser.execute_script(axis.format("figure-error", "yaxis.type")) == "linear"

    first = page.lines("figure-trajectory")
    page.slide("figure-trajectory", 0.99)
    last = page.changed("figure-trajectory", first)
    value = "return document.querySelector('#figure-trajectory .slider-label').textContent"
    assert browser.execute_script(value) == "trajectory 4"
    page.choose("figure-trajectory", "lnn")
    alone = page.changed("figure-trajectory", last)
    assert len(alone) == len(last) - 4  # hnn is gone from three coordinates and the error
    page.slide("figure-trajectory", 0.01)
    assert len(page.changed("figure-trajectory", alone)) == len(alone)  # and stays away
    assert page.fine()


def test_the_controls_of_a_control_run_work(browser, control):
    page = Opened(browser, control)
    for figure in ("figure-motion", "figure-inputs"):
        first = page.lines(figure)
        page.slide(figure, 0.99)
        last = page.changed(figure, first)
        page.choose(figure, "pd")
        assert len(page.changed(figure, last)) < len(last)
    details = browser.find_element(By.CSS_SELECTOR, "details")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", details)
    assert not details.find_element(By.TAG_NAME, "table").is_displayed()
    details.find_element(By.TAG_NAME, "summary").click()
    assert details.find_element(By.TAG_NAME, "table").is_displayed()
    assert page.fine()


@pytest.mark.parametrize(
    "content", ["<script>nothing.at(1)</script>", '<img src="missing.png">', ""]
)
def test_an_error_on_the_console_would_be_noticed(browser, tmp_path, content):
    path = tmp_path / "page.html"
    path.write_text(f"<!DOCTYPE html><p class=main-svg>A figure</p>{content}")
    assert Opened(browser, path).fine() == (not content)


def test_a_phone_shows_the_page_in_its_width(browser, prediction):
    size = browser.get_window_size()
    browser.set_window_size(500, 900)  # the narrowest window that Chromium makes
    try:
        page = Opened(browser, prediction)
        root = "return document.documentElement.{}"
        width = browser.execute_script(root.format("clientWidth"))
        assert browser.execute_script(root.format("scrollWidth")) <= width
        assert page.find("figure-error", ".main-svg")[0].size["width"] <= width
    finally:
        browser.set_window_size(size["width"], size["height"])
