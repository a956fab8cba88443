"""The ``humansim`` command line."""
