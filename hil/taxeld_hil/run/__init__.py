"""A scenario's run: on the fake clock, in real time or on hardware; its table and its picture.

It puts the other rooms together. Only the command line and the experiment import it.
"""
