# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.recipes`; see command.py."""

import sys

from studies.start import start

if __name__ == '__main__':
    sys.exit(start('studies.recipes.command'))
