"""A scenario's run, on the fake clock, in real time or on hardware, which leaves a session."""
