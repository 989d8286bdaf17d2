# SPDX-License-Identifier: Apache-2.0
"""Progress bars: on a terminal only; in a log they are a line now and then."""

import sys
from typing import Any

from tqdm import tqdm

PERIOD = 30.0
"""Seconds between two lines in a log; work that ends sooner leaves none."""


class Lines:
    """A text stream on stderr that writes each state of a bar as a line of its own."""

    def write(self, text: str) -> None:
        """Write a line, without the characters that move a terminal's cursor."""
        line = text.strip()
        if line:
            sys.stderr.write(f'{line}\n')

    def flush(self) -> None:
        """Write out what is buffered."""
        sys.stderr.flush()


def progress(*arguments: Any, **options: Any) -> Any:
    """Return a `tqdm` with these arguments, fit for a terminal or for a log."""
    if sys.stderr.isatty():
        return tqdm(*arguments, **options)
    period = {'mininterval': PERIOD, 'maxinterval': PERIOD, 'delay': PERIOD}
    return tqdm(*arguments, **{**options, 'file': Lines(), **period})
