# SPDX-License-Identifier: Apache-2.0
"""demo --live: the page that a browser shows while the demonstration runs."""

import base64
from contextlib import suppress
from html.parser import HTMLParser
import io
import shutil

import pytest

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

import bag_files as files
from fhaosmo_ros.nodes.recording.topic_recorder import Sample
from fhaosmo_ros.tools.bags.types import labelled_array
from fhaosmo_ros.tools.demo.live import LivePage
import matplotlib.image
import numpy as np
from waiting import wait_until

pytestmark = pytest.mark.ros
STEP = 10_000_000


class Page(HTMLParser):
    """What a browser would find: whether it loads the page again, its text and its pictures."""

    def __init__(self, path):
        super().__init__()
        self.reloads, self.words, self.pictures = None, [], []
        self.feed(path.read_text(encoding='utf-8'))
        self.close()

    def handle_starttag(self, tag, attributes):
        of = dict(attributes)
        if tag == 'meta' and of.get('http-equiv') == 'refresh':
            self.reloads = float(of['content'])
        assert tag not in ('script', 'link')  # it needs nothing else
        if tag == 'img':
            head, _, text = of['src'].partition(',')
            assert head == 'data:image/png;base64'
            self.pictures.append(base64.b64decode(text, validate=True))

    def handle_data(self, data):
        self.words.append(data)

    @property
    def picture(self):
        (png,) = self.pictures
        return matplotlib.image.imread(io.BytesIO(png), format='png')


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    return LivePage()


def feed(page, begin, end, height, deviation=True):
    for k in range(begin, end):
        page.take(Sample('/plant/unknown_input', k * STEP, files.float64(height)))
        page.take(Sample('/estimator/unknown_input', k * STEP, files.float64(0.9 * height)))
        if deviation:
            sizes = labelled_array(['z1', 'd'], np.array([1.0, 0.1 if k > 5 else np.inf]))
            page.take(Sample('/estimator/standard_deviation', k * STEP, sizes))
        page.take(Sample('/estimator/state', k * STEP, labelled_array(['z1'], np.zeros(1))))


def test_the_page_reloads_and_shows_more_each_time(page):
    assert Page(page.path).reloads == pytest.approx(1.0)
    assert Page(page.path).pictures == []
    page.update('too early')
    assert Page(page.path).pictures == []
    feed(page, 0, 50, 1.0)
    page.update('1 of 20 s')
    first = Page(page.path)
    assert '1 of 20 s' in first.words
    feed(page, 50, 100, -1.0)
    page.update('2 of 20 s')
    second = Page(page.path)
    assert second.reloads
    assert not np.array_equal(first.picture, second.picture)
    assert [path.name for path in page.path.parent.iterdir()] == ['demo.html']


def test_fixed_gains_have_no_band(page):
    feed(page, 0, 50, 1.0, deviation=False)
    page.update('')
    without = Page(page.path).picture
    feed(page, 50, 60, 1.0)
    page.update('')
    assert not np.array_equal(Page(page.path).picture, without)


def test_at_the_end_it_shows_the_whole_figure_and_stays(page, tmp_path):
    figure = tmp_path / 'figure.png'
    matplotlib.image.imsave(figure, np.ones((3, 4)))
    page.finish('finished: <here> & there', figure)
    last = Page(page.path)
    assert last.reloads is None
    assert last.pictures == [figure.read_bytes()]
    assert 'finished: <here> & there' in last.words


@pytest.mark.parametrize('display', ['', ':0'])
def test_it_is_opened_where_there_is_a_display(page, monkeypatch, display):
    opened = []
    monkeypatch.setattr('webbrowser.open', opened.append)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    monkeypatch.setenv('DISPLAY', display)
    page.open()
    assert opened == ([page.path.as_uri()] if display else [])


@pytest.fixture(name='browser')
def _browser():
    webdriver = pytest.importorskip('selenium.webdriver')
    chromium, driver = shutil.which('chromium'), shutil.which('chromedriver')
    if not (chromium and driver):
        pytest.skip('no chromium with its chromedriver (Debian: chromium-driver)')
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in ('--headless=new', '--no-sandbox', '--disable-dev-shm-usage'):
        options.add_argument(option)
    service = webdriver.ChromeService(executable_path=driver)
    browser = webdriver.Chrome(options=options, service=service)
    yield browser
    browser.quit()


SHOWN = """
const text = document.querySelector('p'), picture = document.querySelector('img');
return [text ? text.textContent : '', picture ? picture.naturalWidth : 0, performance.timeOrigin];
"""


def test_a_browser_loads_it_again_by_itself_until_the_end(page, browser, tmp_path):
    """And can decode its pictures."""
    errors = pytest.importorskip('selenium.common.exceptions')

    def wait_for(wanted):
        def seen():
            with suppress(errors.WebDriverException):  # it is being loaded
                text, width, loaded = browser.execute_script(SHOWN)
                if text == wanted and width > 0:
                    times.append(loaded)
            return len(times) > before

        before = len(times)
        wait_until(seen, f'picture below {wanted!r}')

    times = []
    browser.get(page.path.as_uri())
    for k, height in enumerate((1.0, -1.0)):
        feed(page, 50 * k, 50 * (k + 1), height)
        page.update(f'{k + 1} of 20 s')
        wait_for(f'{k + 1} of 20 s')
    figure = tmp_path / 'figure.png'
    matplotlib.image.imsave(figure, np.ones((3, 4)))
    page.finish('finished', figure)
    wait_for('finished')
    assert times == sorted(set(times))  # each was another load
    assert not browser.get_log('browser')  # no errors, no warnings
