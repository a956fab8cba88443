"""Check whether a person moves as fast as people do. A wrong frame rate shows in the movement of hands and
feet."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.matching.file_frame import FileFrame

#: Fewest and most frames that are examined, from the middle of a motion.
_FRAMES = 8, 2000
#: A hand or a foot moves if its spread about its mean place relative to the hips is larger than the first
#: value (RMS, metres). A person walks if the hips move farther than the second value (metres).
_MOVES, _WALKS = 0.04, 1.0
#: Joints that show how a limb moves, the best first.
_LEG, _ARM = ("Ankle", "Knee"), ("Wrist", "Elbow")
#: Largest acceleration of hands and feet (RMS, m/s^2). Sprints reach 90, dances 20, walks 5 to 13.
_MOST = 120.0
#: Lowest plausible frequency (Hz) of the fastest movement, for people who walk and for others. Usual are 1.7
#: to 3 Hz and 0.4 to 5 Hz.
_LEAST = {True: 0.15, False: 0.03}
#: Usual frequency (Hz) of the feet of a person who walks, and of the hands and feet of other people.
_USUAL = {True: 1.05, False: 0.45}
#: Usual frame rates of files.
_RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0, 240.0)
_OFTEN = (30.0, 60.0, 120.0)


def pace_warning(motion: Motion, roles: Mapping[str, int], frame: FileFrame, speed: float) -> str | None:
    """Warn about a frame rate with which a person is too fast or too slow, and name a likely rate.

    None if the frame rate is plausible.

    Feet of people who walk go back and forth about once a second, whatever their speed. Rates that are wrong
    by a factor of less than three or four remain plausible.

    Args:
        motion: Motion of a file.
        roles: Role -> joint.
        frame: Coordinate frame of the file.
        speed: Seconds of the file per second.
    """
    ends = ([f"{side}{part}" for part in limb] for limb in (_LEG, _ARM) for side in ("Left", "Right"))
    limbs = [next(role for role in end if role in roles) for end in ends if roles.keys() & {*end}]
    joints = [roles[role] for role in ("LeftHip", "RightHip", *limbs)]
    start = max(0, (motion.n_frames - _FRAMES[1]) // 2)
    places = frame.unit * motion.world_positions(slice(start, start + _FRAMES[1]))[:, joints]
    if len(places) < _FRAMES[0]:
        return None
    hips = places[:, :2].mean(1)
    beside = places[:, 2:] - hips[:, None]
    spread = np.sqrt(((beside - beside.mean(0)) ** 2).sum(-1).mean(0))
    moving = spread > _MOVES
    if not moving.any():
        return None
    rate = speed / motion.frame_time
    speeds = rate * np.linalg.norm(np.diff(beside[:, moving], axis=0), axis=-1)
    spread = spread[moving]
    # single wrong frames must not count
    usual = np.sqrt((np.minimum(speeds, np.quantile(speeds, 0.95, axis=0)) ** 2).mean(0))
    turns = 2 * np.pi * spread
    walks = bool(np.linalg.norm(np.ptp(hips, axis=0)) > _WALKS)
    feet = np.array([role.endswith(_LEG) for role in limbs])[moving]
    which = feet if walks and feet.any() else np.ones_like(feet)
    too_slow = float((np.quantile(speeds, 0.999, axis=0) / turns)[which].max()) < _LEAST[walks]
    if not too_slow and float((usual**2 / spread)[which].min()) < _MOST:
        return None
    measured = rate * _USUAL[walks] / float(np.median((usual / turns)[which]))
    # some files store the rate instead of the time, or the time in milliseconds
    stated = (motion.frame_time, 1000 / motion.frame_time)
    meant = [each for each in _RATES if np.abs(np.divide(stated, each) - 1).min() < 0.01] or _RATES
    likely = min(meant, key=lambda each: abs(np.log(each / measured)) + 0.15 * (each not in _OFTEN))
    way = float(np.linalg.norm(np.diff(hips, axis=0), axis=-1).mean()) * rate
    return (
        f"the person moves at {way:.3g} m/s, with hands and feet at up to {speeds.max():.3g} m/s: too "
        f"{'slow' if too_slow else 'fast'}. The frame rate, {rate:.6g} frames per second, is hardly right; "
        f"{likely:g} are likely (speed: {likely * motion.frame_time:.4g})"
    )
