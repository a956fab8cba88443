"""Write the reference data of actions of the face: test/data/anny_faces.npz (see test/data/README.md).

    python tools/anny_faces.py test/data/anny_faces.npz

Needs torch and anny 0.6.2, in an environment of its own.
"""

from __future__ import annotations

import sys

import anny
import numpy as np
import torch
from anny.models.model_data import TopologyConfig

TOPOLOGY = TopologyConfig("makehuman", False, False, False)
SLIDERS = {"gender": 1.0, "age": 0.66, "muscle": 0.5, "weight": 0.5, "height": 0.5, "proportions": 0.5}


def main() -> None:
    model = anny.Anny("anny", TOPOLOGY, facial_actions="all", phenotype_blendshapes="original")
    model = model.to(dtype=torch.float64)
    names = model.facial_action_labels

    def vertices(weights: np.ndarray) -> np.ndarray:
        face = dict(zip(names, weights.tolist(), strict=True))
        x, y, z = model(phenotype_kwargs=SLIDERS, facial_actions=face)["rest_vertices"][0].numpy().T
        return np.stack([x, z, -y], axis=1)

    rest = vertices(np.zeros(len(names)))
    weights = np.random.default_rng(0).uniform(0, 1, (3, len(names)))
    single = np.array([vertices(row) - rest for row in np.eye(len(names))])
    mixed = np.array([vertices(row) - rest for row in weights])
    moved = np.flatnonzero(np.abs(single).max(axis=(0, 2)) > 0)
    rows = np.sort(np.random.default_rng(1).choice(moved, 500, replace=False))
    np.savez_compressed(
        sys.argv[1],
        names=np.array(names),
        rows=rows.astype(np.int32),
        single=single[:, rows].astype(np.float32),
        weights=weights,
        mixed=mixed[:, rows],
    )


if __name__ == "__main__":
    main()
