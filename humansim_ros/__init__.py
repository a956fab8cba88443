"""Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2 or in one process."""

__version__: str


def __getattr__(name: str) -> str:
    if name == "__version__":
        from humansim_ros.resources import package_version

        return package_version()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
