"""Array types that the whole package shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Double precision, for computations of the core.
Array = NDArray[np.float64]
#: Single precision, for vertices and for results of the renderer.
Float32Array = NDArray[np.float32]
#: Single or double precision.
FloatArray = NDArray[np.floating]
#: Indices into arrays.
Indices = NDArray[np.intp]
#: (H, W) grey or (H, W, 3) sRGB images.
Image = NDArray[np.uint8]
#: Width and height of an image in pixels.
ImageSize = tuple[int, int]
#: Red, green, blue; sRGB, 0 to 255.
Color = tuple[int, int, int]
#: Red, green, blue; linear light.
LinearColor = tuple[float, float, float]
