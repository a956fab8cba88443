"""The executables of the package: motion_player, skinner, camera, camera_rig, scanner, recorder and
evaluator.
"""
