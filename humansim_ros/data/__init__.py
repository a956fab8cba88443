"""Output of a scene for other programs: messages, bags, data sets; and evaluation."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
