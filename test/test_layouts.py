# SPDX-License-Identifier: Apache-2.0
"""Layouts for PlotJuggler and Foxglove name what the nodes publish; the site has no lost link."""

import json
from pathlib import Path
import re
import subprocess
import sys
from urllib.parse import unquote
from xml.etree import ElementTree

from fhaosmo_ros.topics import ARRAY, estimates_of, FLOAT, TRUTH, TYPED_ESTIMATES
import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYOUTS = ROOT / 'config' / 'layouts'
TYPES = {'/y': FLOAT}
TYPES |= {f'/estimator/{name}': kind for name, kind in estimates_of({'gains': 'fixed'}).items()}
TYPES |= {f'/plant/{name}': kind for name, kind in TRUTH.items()}
TYPES |= {f'/joint_estimator/{name}': kind for name, kind in TYPED_ESTIMATES.items()}
FIELDS = {FLOAT: r'data', ARRAY: r'data\[\d\]'}
JOINTS = ('position', 'velocity', 'effort')


def known(topic, field, joint_field):
    assert topic in TYPES
    assert re.fullmatch(FIELDS.get(TYPES[topic], joint_field), field)


@pytest.mark.parametrize('path', sorted(LAYOUTS.glob('*.xml')), ids=lambda p: p.stem)
def test_curves_of_plotjuggler(path):
    root = ElementTree.parse(path).getroot()
    subscribed = {topic.get('name') for topic in root.iter('topic')}
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert curves
    for curve in curves:
        (topic,) = (t for t in subscribed if curve.startswith(f'{t}/'))
        known(topic, curve.removeprefix(f'{topic}/'), rf'\w+/({"|".join(JOINTS)})')


@pytest.mark.parametrize('path', sorted(LAYOUTS.glob('*.json')), ids=lambda p: p.stem)
def test_paths_of_foxglove(path):
    layout = json.loads(path.read_text())
    panels, places = layout['configById'], [layout['layout']]
    shown = []
    while places:
        place = places.pop()
        if isinstance(place, str):
            shown.append(place)
        else:
            assert place['direction'] in ('row', 'column')
            places += [place['first'], place['second']]
    assert sorted(shown) == sorted(panels)
    for panel, content in panels.items():
        assert panel.startswith('Plot!')
        for curve in content['paths']:
            topic, _, field = curve['value'].partition('.')
            known(topic, field, rf'({"|".join(JOINTS)})\[\d\]')


# The site


def test_site_builds_and_its_links_lead_somewhere(tmp_path):
    """Without a warning."""
    pytest.importorskip('myst_parser', reason='sphinx is not installed: extra docs')
    command = [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-d', tmp_path / 'made']
    done = subprocess.run(
        [*command, ROOT / 'docs', tmp_path / 'site'], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    pages = {path: path.read_text() for path in (tmp_path / 'site').glob('*.html')}
    assert len(pages) > 10
    places = {path.name: set(re.findall(r'id="([^"]+)"', text)) for path, text in pages.items()}
    lost = []
    for path, text in pages.items():
        for link in re.findall(r'(?:href|src)="([^"]+)"', text):
            if re.match(r'[a-z]+:|//', link):
                continue
            name, _, place = unquote(link).partition('#')
            target = path.parent / name.partition('?')[0] if name else path
            if not target.exists() or (place and place not in places.get(target.name, {place})):
                lost.append((path.name, link))
    assert not lost
    assert 'Observer.smooth' in (tmp_path / 'site' / 'offline.html').read_text()
