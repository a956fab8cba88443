"""People from files: descriptions, meshes that are fitted and rigged, figures with skeletons of their own."""

from humansim_ros.people.loading import load_human, make_human

__all__ = ["load_human", "make_human"]
