"""The engine: do the work of a plan in shards, with any number of processes or on a Ray cluster, and continue
interrupted work."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
