"""Humans from photographs: fitting of a body to calibrated views, and textures from them."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.photographs.views import Photo as Photo
    from humansim_ros.photographs.views import PhotoSet as PhotoSet
    from humansim_ros.photographs.views import read_views as read_views

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"PhotoSet": "views", "Photo": "views", "read_views": "views"}
)
