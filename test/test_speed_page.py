# SPDX-License-Identifier: Apache-2.0
"""What docs/speed.md says is what the benchmark measured, and still measures."""

import importlib
from pathlib import Path

import pytest
from studies import document

BENCHMARK = Path(__file__).resolve().parents[1] / 'benchmark'


@pytest.fixture(name='page')
def _page(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARK)
    return importlib.import_module('page')


def test_the_page_says_what_was_measured(page):
    kept = page.kept()
    shown = document.parts(page.PAGE.read_text(encoding='utf-8'))
    assert shown == {name: page.text(found) for name, found in kept.items()}


@pytest.mark.ros
def test_every_part_is_on_a_page(page):
    pytest.importorskip('rclpy')
    run = importlib.import_module('run')
    assert set(page.kept()) == set(run.PARTS)


def test_a_part_replaces_only_itself(page, tmp_path, monkeypatch):
    table = importlib.import_module('table')
    path = tmp_path / 'speed.md'
    markers = '<!-- begin {0} -->\n<!-- end {0} -->\n'
    path.write_text(markers.format('core') + 'words\n' + markers.format('tune'), encoding='utf-8')
    monkeypatch.setattr(page, 'PAGE', path)
    rows = [table.Row('a step', 1.5, 'us', bar=1.0, note='10 runs')]
    timings = table.Table('Times.', ('rate', 'ms'), [('100', '3')])
    page.write({'core': page.part(rows, 'a machine')})
    page.write({'tune': page.part([table.Row('a trial', 2.0, 'ms'), timings], 'another')})
    shown = document.parts(path.read_text(encoding='utf-8'))
    assert '| a step | 1.5 us | <= 1 | MISSED | 10 runs |' in shown['core'].splitlines()
    assert {'| a trial | 2 ms |  |', '| 100 | 3 |'} <= set(shown['tune'].splitlines())
    assert shown == {name: page.text(found) for name, found in page.kept().items()}
