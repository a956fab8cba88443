"""The motion player: lockstep, real time, services."""
