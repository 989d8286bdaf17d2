# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md says what its tables say, and these have the paper's findings."""

import pytest
import results
from studies import comparison, everywhere, evidence, paper

MAKERS = {
    'speed': results, 'comparison': comparison, 'everywhere': everywhere, 'paper': paper,
}  # fmt: skip


@pytest.mark.parametrize('name', MAKERS)
def test_the_page_says_what_the_table_says(name):
    shown = evidence.parts((evidence.DOCS / evidence.PAGE).read_text(encoding='utf-8'))
    texts = MAKERS[name].texts(evidence.read(name))
    assert {part: shown[part] for part in texts} == texts


def test_best_solver_and_all_findings_come_out():
    rows = evidence.read('paper')
    documented = {of: paper.scores_of(rows, of) for of in (paper.SOLVER, *paper.EARLIER)}

    def error(solver):
        return sum(documented[solver][paper.FINE, w]['rms_d'] for w in paper.FREQUENCIES)

    *_, held = paper.EARLIER
    assert min(set(documented) - {held}, key=error) == paper.SOLVER
    assert all(v.holds for v in paper.verdicts(documented[paper.SOLVER]))
