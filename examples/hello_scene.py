"""Make a scene in Python, without any file, and look at its first frame.

python examples/hello_scene.py
"""

from __future__ import annotations

from humansim_ros import Scene, Simulation


def main() -> None:
    scene = Scene.from_dict(
        {
            "rate": 30,
            "humans": {
                "anna": {"body": "adult_woman", "motion": {"file": "walk", "position": [0, 0.5]}},
                "ben": {"body": "adult_man", "motion": {"file": "wave", "position": [0, -0.5]}},
            },
            "cameras": {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 0.9], "fov_deg": 60}},
        }
    )
    with Simulation(scene, channels=("rgb", "depth", "instance", "part")) as simulation:
        for frame in simulation.frames(1):
            print(frame)
            print(frame.views["front"])
            for name, human in frame.humans.items():
                # the end of the topmost bone
                head = human.positions[human.joint_names.index("vt3_end")]
                seen = frame.joints["front"][name]
                print(f"{name}: the head is at {head.round(3)} m in map; {seen}")


if __name__ == "__main__":
    main()
