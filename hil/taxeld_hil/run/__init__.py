"""A scenario's run: on the fake clock, in real time or on hardware, which leaves a session.

It puts the other rooms together. Only the command line and the experiment import it.
"""
