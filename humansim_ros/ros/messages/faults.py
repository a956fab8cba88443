"""Messages about the faults of a camera: its settings, and what is wrong with each frame."""

from __future__ import annotations

import json

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String

from humansim_ros.ros.messages.headers import header
from humansim_ros.scene.faults import FaultSchedule, FrameFaults


def faults_message(faults: FrameFaults, stamp: int, frame: str) -> DiagnosticArray:
    """Build ``<camera>/faults``: a status for each fault of a frame, with its values.

    Args:
        faults: Faults of the frame.
        stamp: Stamp of the frame, nanoseconds; that of its image may be wrong.
        frame: Optical frame of the camera.
    """
    message = DiagnosticArray(header=header(stamp, frame))
    for kind, values in faults.kinds.items():
        status = DiagnosticStatus(level=DiagnosticStatus.WARN, name=kind, hardware_id=frame)
        status.values = [KeyValue(key=key, value=repr(value)) for key, value in values.items()]
        message.status.append(status)
    return message


def read_faults(message: DiagnosticArray) -> dict[str, dict[str, float]]:
    """Read the values of the faults of a frame by their kind."""
    return {
        status.name: {value.key: float(value.value) for value in status.values} for status in message.status
    }


def faults_legend(schedule: FaultSchedule) -> String:
    """Build ``<camera>/faults/legend``: the section ``faults`` of the camera as JSON."""
    return String(data=json.dumps(schedule.config.model_dump(exclude_none=True)))
