"""Data sets of a scene in the formats of other programs: images, annotations, calibrations, motions."""
