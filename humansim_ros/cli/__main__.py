"""``python -m humansim_ros.cli``: the ``humansim`` command without its script."""

import sys

from humansim_ros.cli.main import main

sys.exit(main())
