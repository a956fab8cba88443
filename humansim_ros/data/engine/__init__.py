"""Work on the frames of a scene in several processes, or on a Ray cluster."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
