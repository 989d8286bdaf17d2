# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.comparison`; see command.py."""

import sys

from studies.start import start

if __name__ == '__main__':
    sys.exit(start('studies.comparison.command'))
