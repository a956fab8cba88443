"""Old path of names that have moved; 0.4.0 removes it."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__, have_moved=True)
