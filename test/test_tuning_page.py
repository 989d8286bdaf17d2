# SPDX-License-Identifier: Apache-2.0
"""Tuning: docs/tuning.json against a short new run."""

import json

import pytest

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')
from studies import tuning

REWRITE = 'run python -m studies.tuning'


@pytest.fixture(scope='module')
def documented():
    return json.loads(tuning.PAGE.with_suffix('.json').read_text())


@pytest.mark.slow
def test_a_bag_gives_gains_of_the_documented_error(documented):
    name, kind = 'motor', 'square'
    error = tuning.error_with(tuning.gains_of_bag(name, kind), tuning.judging(name, kind))
    assert error == pytest.approx(documented['bags'][name][kind]['error'], rel=0.05), REWRITE


def test_a_preset_has_the_documented_error(documented):
    noise = tuning.NOISES[1]
    for title, values in tuning.presets_at(noise, lambda: None, scan=False).items():
        assert values == pytest.approx(documented['presets'][noise][title], rel=0.02), REWRITE
