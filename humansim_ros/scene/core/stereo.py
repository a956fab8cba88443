"""Stereo pairs of a scene: names, without the libraries of cameras."""


def right_camera(left: str) -> str:
    """Name of the second camera of a stereo pair."""
    return left.replace("left", "right") if "left" in left else f"{left}_right"
