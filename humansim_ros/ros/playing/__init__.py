"""How the motion player sends frames: in lockstep or in real time, and controlled by services."""
