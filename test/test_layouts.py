# SPDX-License-Identifier: Apache-2.0
"""The layouts for PlotJuggler and Foxglove are well formed and name what the nodes publish."""

import json
from pathlib import Path
import re
from xml.etree import ElementTree

from fhaosmo_ros.topics import ARRAY, estimates_of, FLOAT, TRUTH, TYPED_ESTIMATES
import pytest

LAYOUTS = Path(__file__).resolve().parents[1] / 'config' / 'layouts'
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
    assert root.tag == 'root'
    for splitter in root.iter('DockSplitter'):
        count = int(splitter.get('count'))
        assert len(splitter) == count == len(splitter.get('sizes').split(';'))
    subscribed = {topic.get('name') for topic in root.iter('topic')}
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert curves
    for curve in curves:
        (topic,) = (t for t in subscribed if curve.startswith(f'{t}/'))
        known(topic, curve.removeprefix(f'{topic}/'), rf'\w+/({"|".join(JOINTS)})')


@pytest.mark.parametrize('path', sorted(LAYOUTS.glob('*.json')), ids=lambda p: p.stem)
def test_paths_of_foxglove(path):
    layout = json.loads(path.read_text())
    panels, places = [], [layout['layout']]
    while places:
        place = places.pop()
        if isinstance(place, str):
            panels.append(place)
        else:
            assert place['direction'] in ('row', 'column')
            places += [place['first'], place['second']]
    assert sorted(panels) == sorted(layout['configById'])
    for panel in panels:
        assert panel.startswith('Plot!')
        for curve in layout['configById'][panel]['paths']:
            topic, _, field = curve['value'].partition('.')
            known(topic, field, rf'({"|".join(JOINTS)})\[\d\]')
