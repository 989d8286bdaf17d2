# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.comparison`; see command.py."""

import sys

from studies.comparison.command import main

if __name__ == '__main__':
    sys.exit(main())
