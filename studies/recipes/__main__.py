# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.recipes`; see command.py."""

import sys

from studies.recipes.command import main

if __name__ == '__main__':
    sys.exit(main())
