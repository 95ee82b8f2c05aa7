"""``python -m mass_engine`` is ``mass-engine``."""

import sys

from mass_engine.cli import main

sys.exit(main())
