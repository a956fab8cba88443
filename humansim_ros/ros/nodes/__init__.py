"""The executables of the package: motion_player, skinner, skinner_rig, camera, camera_rig, scanner, recorder,
evaluator, bridge and hri_bridge.
"""
