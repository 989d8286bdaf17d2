# SPDX-License-Identifier: Apache-2.0
"""The recipe for an encoder, in short: what its page says of the three methods."""

from pathlib import Path

from fhaosmo_ros.core import Family
import pytest
from studies import encoder

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'encoder.md'


@pytest.mark.parametrize(
    ('way', 'choice', 'line'),
    [
        (encoder.savitzky_golay, (71, 3), 'Savitzky-Golay, causal'),
        (encoder.observer, (135.7208808297453,), 'this observer'),
    ],
)
def test_the_page_says_what_is_measured(way, choice, line):
    unseen = Family(encoder.JOINT).recordings(2 * encoder.RECORDINGS)[encoder.RECORDINGS :]
    row = next(text for text in PAGE.read_text().splitlines() if text.startswith(f'| {line}'))
    printed = [float(cell) for cell in row.split('|')[2:4]]
    assert encoder.errors(unseen, way, choice) == pytest.approx(printed, rel=0.01)
