"""One job on many frames, in this process, in several, or on a Ray cluster."""
