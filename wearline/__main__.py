"""``python -m wearline`` is the ``wearline`` command."""

import sys

from wearline.cli import main

sys.exit(main())
