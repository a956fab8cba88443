"""Model of a camera sensor: from rendered images to the images of a driver."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
