"""Compare estimated poses of people with the truth: errors, detection, tracking, and reports."""

from humansim_ros import make_callable

make_callable(__name__)
