# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md says what stands in the tables beside it, and these are about everything."""

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import pytest
import results
from studies import comparison, everywhere, evidence, paper
from studies.comparison import methods_for, sensors
from studies.plant_and_observer import SOLVERS

PARTS = {
    'speed': results.texts,
    'comparison': comparison.texts,
    'everywhere': everywhere.texts,
    'paper': paper.texts,
}
"""What makes the parts of the page, by the name of the table they are made from."""


@pytest.mark.parametrize('name', PARTS)
def test_the_page_says_what_the_table_says(name):
    shown = evidence.parts((evidence.DOCS / evidence.PAGE).read_text(encoding='utf-8'))
    texts = PARTS[name](evidence.read(name))
    assert {part: shown[part] for part in texts} == texts


def test_tables_are_about_all_cells():
    compared = {tuple(row.values())[:6] for row in evidence.read('comparison')}
    assert compared == {
        (s.plant, d, s.noise, s.rate, s.timing, method)
        for s in sensors()
        for d in s.disturbances
        for method in methods_for(s)
    }
    cells = {(row['plant'], row['condition']) for row in evidence.read('everywhere')}
    assert cells == {(p, c) for p in everywhere.PLANTS for c in everywhere.CONDITIONS}
    simulations = {tuple(row.values())[:3] for row in evidence.read('paper')}
    assert simulations == {
        (s, name, w) for s in SOLVERS for name in paper.OBSERVERS for w in paper.FREQUENCIES
    }


def test_a_table_is_read_as_it_was_written_and_the_page_is_filled(tmp_path):
    page = tmp_path / evidence.PAGE
    page.write_text('before\n<!-- begin a -->\nold\n<!-- end a -->\nafter\n')
    rows = [{'name': 'x, y', 'value': 1.5, 'other': None}, {'name': 'z', 'value': 2e9, 'other': 0}]
    evidence.publish(tmp_path, {'table': rows}, {'a': evidence.markdown(['h'], [['1']])}, {})
    assert evidence.read('table', tmp_path) == rows
    assert page.read_text() == (
        'before\n<!-- begin a -->\n| h |\n| --- |\n| 1 |\n<!-- end a -->\nafter\n'
    )
    with pytest.raises(ConfigurationError, match='expected b, got a'):
        evidence.publish(tmp_path, {'table': rows[:1]}, {'b': ''}, {})
    assert evidence.read('table', tmp_path) == rows
