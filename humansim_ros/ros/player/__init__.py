"""Parts of the motion player: real time, motions, services."""
