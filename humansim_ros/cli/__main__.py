"""``python -m humansim_ros.cli``: the ``humansim`` command without its script."""

from humansim_ros.cli.main import main

main()
