"""Writers of all export formats, such as COCO, and readers of some of these formats."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
