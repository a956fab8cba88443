"""Motion of a person in photographs: markerless motion capture."""

from __future__ import annotations

import numpy as np

from humansim_ros.motion.export import PosedBones
from humansim_ros.motion.kinematics import Motion
from humansim_ros.photographs.person_fit import PersonFit


def fit_motion(fit: PersonFit) -> Motion:
    """Motion of the F frames of a fit, with the skeleton of the person, to write as BVH.

    With ``anchor: file`` in a scene, the person moves where it was photographed.
    """
    posed = np.array([fit.posed(frame) for frame in range(len(fit.root))])
    return PosedBones(fit.body.skeleton, posed, fit.period / 1e9).to_motion()
