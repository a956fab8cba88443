"""Deprecated path of ``SceneRecording``. It goes in 0.3.0."""

import warnings

from humansim_ros.record.recording import SceneRecording as SceneRecording

warnings.warn("import SceneRecording from humansim_ros.record.recording", DeprecationWarning, stacklevel=2)
