"""Put the motion of a BVH file onto a human, and write its joints and vertices as NumPy arrays.

python examples/retarget_bvh.py FILE.bvh OUTPUT.npz [BODY]
"""

from __future__ import annotations

import sys

import numpy as np

from humansim_ros import Scene, read_motion


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    motion = read_motion(sys.argv[1])
    print(f"{motion.n_frames} frames of {motion.n_joints} joints, {motion.duration:.2f} s")
    body = sys.argv[3] if len(sys.argv) > 3 else "adult_man"
    # a camera is needed to render; none is rendered here
    scene = Scene.build(
        humans={"actor": {"body": body, "motion": motion}},
        cameras={"unused": {"position": [3, 0, 1], "look_at": [0, 0, 1]}},
    )
    actor = scene.actors["actor"]
    states = [actor.at(seconds) for seconds in np.arange(motion.n_frames) * motion.frame_time]
    np.savez_compressed(
        sys.argv[2],
        joint_names=states[0].joint_names,
        joints=[state.joints for state in states],  # (N, J, 4, 4) poses in map, metres
        vertices=[state.vertices for state in states],  # (N, V, 3) metres
        faces=actor.human.mesh.triangles,
    )
    print(f"{len(states)} poses of {len(states[0].joint_names)} joints written to {sys.argv[2]}")


if __name__ == "__main__":
    main()
