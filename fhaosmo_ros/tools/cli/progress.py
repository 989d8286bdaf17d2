# SPDX-License-Identifier: Apache-2.0
"""Progress bars: on a terminal only; in a log they are a line now and then."""

import sys
from typing import Any

from tqdm import tqdm

PERIOD = 30.0
"""Seconds between two lines in a log; work that ends sooner leaves none."""


class _Lines:
    """stderr, where each state of a bar is a line without what moves a terminal's cursor."""

    def write(self, text: str) -> None:
        if line := text.strip():
            sys.stderr.write(f'{line}\n')

    def flush(self) -> None:
        sys.stderr.flush()


def progress(*arguments: Any, **options: Any) -> Any:
    """Return a `tqdm` with these arguments, fit for a terminal or for a log."""
    if not sys.stderr.isatty():
        period = {'mininterval': PERIOD, 'maxinterval': PERIOD, 'delay': PERIOD}
        options |= {'file': _Lines(), **period}
    return tqdm(*arguments, **options)
