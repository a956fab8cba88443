"""The page of ``humansim view``: scenes, bags and running graphs in a browser, live and in 3D."""
