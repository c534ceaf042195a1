"""`python -m marotte`."""

import sys

from marotte.cli import main

sys.exit(main())
