# SPDX-License-Identifier: Apache-2.0
"""
Write fhaosmo_ros/core/observer/fuzzy_curves.csv: the curves psi of the default fuzzy systems.

`python -m studies.fuzzy_curves`, after a change of what scikit-fuzzy is asked for.
"""

import csv

from fhaosmo_ros.core.observer.fuzzy import (
    DEFAULT_CURVES,
    FuzzySystem,
    inferred,
    read_system,
    SHAPES,
)

TEXTS = [f'terms {shape} {terms}' for shape in SHAPES for terms in (5, 7)]


def main() -> None:
    """Infer the curves and write them, each number with all its digits."""
    columns = []
    for text in TEXTS:
        system = read_system(text)
        assert isinstance(system, FuzzySystem)
        columns.append(inferred(system).tolist())
    with DEFAULT_CURVES.open('w', newline='') as file:
        table = csv.writer(file, lineterminator='\n')
        table.writerow(TEXTS)
        table.writerows(zip(*columns, strict=True))


if __name__ == '__main__':
    main()
