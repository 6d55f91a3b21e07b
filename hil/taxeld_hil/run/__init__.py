"""A scenario's run: on the fake clock, in real time, on hardware or for hours; tables and pictures.

It puts the other rooms together. Only the command line and the experiment import it.
"""
