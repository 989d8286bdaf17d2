# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.paper`; see command.py."""

import sys

from studies.start import start

if __name__ == '__main__':
    sys.exit(start('studies.paper.command'))
