"""Compare estimated poses of people with the truth: errors, detection, tracking, and reports."""
