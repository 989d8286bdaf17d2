# SPDX-License-Identifier: Apache-2.0
"""Layouts for PlotJuggler and Foxglove name what the nodes publish; the site builds."""

import json
from pathlib import Path
import re
import subprocess
import sys
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
    panels = layout['configById']
    shown = re.findall(r'Plot!\w+', json.dumps(layout['layout']))
    assert sorted(shown) == sorted(panels)
    for content in panels.values():
        for curve in content['paths']:
            topic, _, field = curve['value'].partition('.')
            known(topic, field, rf'({"|".join(JOINTS)})\[\d\]')


def test_site_builds_without_a_warning(tmp_path):
    """Sphinx warns of links, to pages and to places in them, that lead nowhere."""
    pytest.importorskip('myst_parser', reason='sphinx is not installed: extra docs')
    command = [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-d', tmp_path / 'made']
    done = subprocess.run(
        [*command, ROOT / 'docs', tmp_path / 'site'], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 'Observer.smooth' in (tmp_path / 'site' / 'offline.html').read_text()
