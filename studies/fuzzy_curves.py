# SPDX-License-Identifier: Apache-2.0
"""
Write fhaosmo_ros/core/observer/fuzzy_curves.csv: the curves psi of the default fuzzy systems.

`python -m studies.fuzzy_curves`, after a change of what scikit-fuzzy is asked for.
"""

import csv

from fhaosmo_ros.core.observer.fuzzy import DEFAULT_CURVES, inferred, read_system, SHAPES


def main() -> None:
    """Infer the curves and write them, each number with all its digits."""
    texts = [f'terms {shape} {terms}' for shape in SHAPES for terms in (5, 7)]
    columns = [inferred(read_system(text)).tolist() for text in texts]
    with DEFAULT_CURVES.open('w', newline='') as file:
        csv.writer(file, lineterminator='\n').writerows([texts, *zip(*columns, strict=True)])


if __name__ == '__main__':
    main()
