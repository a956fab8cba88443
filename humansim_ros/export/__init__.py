"""Data sets of a scene in the formats of other programs: images, annotations, calibrations, motions."""

from humansim_ros import make_callable

make_callable(__name__)
