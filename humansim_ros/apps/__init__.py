"""Applications of the nodes, as commands of ``humansim`` run them; layouts for viewers."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.apps.api import Comparison as Comparison
    from humansim_ros.apps.viewer_layouts import foxglove_layout as foxglove_layout
    from humansim_ros.apps.viewer_layouts import rviz_layout as rviz_layout

__getattr__, __dir__, __all__ = lazy_exports(
    __name__, {"Comparison": "api", "foxglove_layout": "viewer_layouts", "rviz_layout": "viewer_layouts"}
)
