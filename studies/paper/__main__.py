# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.paper`; see command.py."""

import sys

from studies.paper.command import main

if __name__ == '__main__':
    sys.exit(main())
