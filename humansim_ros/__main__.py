"""Run the ``humansim`` command by ``python -m humansim_ros``, without its script."""

import sys

from humansim_ros.cli.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
