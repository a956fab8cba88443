"""Compute scores of random sequences with TrackEval, for test/evaluate/test_tracking.py.

Run it in an environment of its own, because the package replaces NumPy and OpenCV::

    python -m venv /tmp/trackeval && /tmp/trackeval/bin/pip install trackeval==1.3.0
    /tmp/trackeval/bin/python tools/trackeval_reference.py test/data/trackeval.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def sequence(seed: int, frames: int = 14, people: int = 4) -> list[dict[str, Any]]:
    """Frames of people who appear, vanish and swap identities; similarities are rounded."""
    rng = np.random.default_rng(seed)
    identity = np.arange(people)
    result = []
    for frame in range(frames):
        if frame in (5, 9):
            identity = rng.permutation(people)
        if frame == 11:
            identity = identity + people
        truth = np.flatnonzero(rng.random(people) < 0.85)
        kept = np.array([i for i in truth if rng.random() < 0.85], int)
        false = [2 * people] if rng.random() < 0.3 else []
        near = np.concatenate([truth[:, None] == kept, np.zeros((len(truth), len(false)))], axis=1)
        similarity = np.clip(0.7 * near + rng.random(near.shape) * 0.4 - 0.05, 0, 1).round(3)
        estimate = [*identity[kept].tolist(), *false]
        result.append({"truth": truth.tolist(), "estimate": estimate, "similarity": similarity.tolist()})
    result[3] |= {"estimate": [], "similarity": [[] for _ in result[3]["truth"]]}
    return result


def scores(frames: list[dict[str, Any]]) -> dict[str, float]:
    """Scores by TrackEval."""
    from trackeval.metrics import CLEAR, HOTA, Identity

    known = [sorted({i for frame in frames for i in frame[kind]}) for kind in ("truth", "estimate")]
    ids = [
        [np.array([table.index(i) for i in frame[kind]], int) for frame in frames]
        for table, kind in zip(known, ("truth", "estimate"), strict=True)
    ]
    data = {
        "num_timesteps": len(frames),
        "gt_ids": ids[0],
        "tracker_ids": ids[1],
        "similarity_scores": [
            np.array(frame["similarity"], float).reshape(len(frame["truth"]), len(frame["estimate"]))
            for frame in frames
        ],
        "num_gt_ids": len(known[0]),
        "num_tracker_ids": len(known[1]),
        "num_gt_dets": sum(map(len, ids[0])),
        "num_tracker_dets": sum(map(len, ids[1])),
    }
    hota = HOTA().eval_sequence(data)
    clear = CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
    identity = Identity({"PRINT_CONFIG": False}).eval_sequence(data)
    return {
        **{name.lower(): float(np.mean(hota[name])) for name in ("HOTA", "DetA", "AssA", "LocA")},
        "mota": float(clear["MOTA"]),
        "motp": float(clear["MOTP"]),
        "switches": int(clear["IDSW"]),
        "fragments": int(clear["Frag"]),
        "idf1": float(identity["IDF1"]),
    }


def main() -> None:
    """Write sequences and scores to the file of the first argument."""
    cases = [{"frames": (frames := sequence(seed)), "scores": scores(frames)} for seed in range(4)]
    import trackeval

    text = json.dumps({"trackeval": trackeval.__version__, "cases": cases})
    Path(sys.argv[1]).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
